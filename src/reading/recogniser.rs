//! Reads straightened lines of text.

use image::RgbImage;

use super::ReadError;
use super::manifest::RecogniserSpec;
use super::model::Model;
use super::tensor::fill;

/// Lines are padded to at least this width, as those that the model was trained on.
const NARROWEST: u32 = 320;

/// Most lines in one batch.
const BATCH: usize = 6;

/// The blank of CTC.
const BLANK: usize = 0;

#[derive(Debug)]
pub(super) struct Recogniser {
    pub model: Model,
    pub spec: RecogniserSpec,
    /// The text of each class.
    pub keys: Vec<String>,
}

impl Recogniser {
    /// The text of each line, and the mean probability of its characters; nothing read has probability 0.
    pub fn read(&self, lines: &[RgbImage]) -> Result<Vec<(String, f32)>, ReadError> {
        // Lines of similar width share a batch, which is padded to the widest.
        let mut order: Vec<usize> = (0..lines.len()).collect();
        order.sort_by_key(|&at| lines[at].width());
        let mut texts = vec![(String::new(), 0.0); lines.len()];
        for batch in order.chunks(BATCH) {
            let width =
                batch.iter().map(|&at| lines[at].width()).fold(NARROWEST, u32::max) as usize;
            let height = self.spec.height as usize;
            let size = 3 * height * width;
            let mut planes = vec![0.0; batch.len() * size];
            for (planes, &at) in planes.chunks_exact_mut(size).zip(batch) {
                fill(planes, width, &lines[at], self.spec.mean, self.spec.std);
            }
            let shape = [batch.len(), 3, height, width];
            self.model.run(shape, &planes, |shape, numbers| {
                let classes =
                    shape.last().and_then(|last| usize::try_from(*last).ok()).unwrap_or(0);
                if classes != self.keys.len() {
                    let keys = self.keys.len();
                    let why =
                        format!("the recogniser gives {classes} classes, its keys are {keys}");
                    return Err(ReadError::Model(why));
                }
                let steps = numbers.len() / batch.len() / classes.max(1);
                if steps == 0 {
                    return Err(ReadError::Model("the recogniser gives no steps".into()));
                }
                for (&at, numbers) in batch.iter().zip(numbers.chunks_exact(steps * classes)) {
                    texts[at] = self.decode(numbers);
                }
                Ok(())
            })?;
        }
        Ok(texts)
    }

    /// Greedy decoding: the most probable class of each step, without repetitions and blanks.
    fn decode(&self, numbers: &[f32]) -> (String, f32) {
        let (mut text, mut sum, mut count) = (String::new(), 0.0, 0);
        let mut before = BLANK;
        for step in numbers.chunks_exact(self.keys.len()) {
            let best = step.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1));
            let Some((class, probability)) = best else { continue };
            if class != before && class != BLANK {
                text.push_str(&self.keys[class]);
                sum += probability;
                count += 1;
            }
            before = class;
        }
        (text, if count == 0 { 0.0 } else { sum / count as f32 })
    }
}
