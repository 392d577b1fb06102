//! Which manifests are valid.

use std::path::{Component, Path};

use super::{Layout, MANIFEST, Manifest};

impl Manifest {
    /// Which values contradict each other, and how.
    pub(crate) fn fault(&self) -> Option<String> {
        const MAX_EDGE: u32 = 4096;
        const MAX_CHANNELS: usize = 1 << 14;
        let (input, output) = (&self.input, &self.output);
        let is_plain = |file: &Path| file.components().count() == 1 && file.file_name().is_some();
        if !is_plain(&self.file) || self.file == Path::new(MANIFEST) {
            return Some("file must be a plain file name next to the manifest".into());
        }
        let is_below = |file: &Path| {
            let mut parts = file.components();
            file.file_name().is_some() && parts.all(|part| matches!(part, Component::Normal(_)))
        };
        if !self.data.iter().all(|data| is_below(&data.file) && data.file != Path::new(MANIFEST)) {
            return Some("data.file must be a file below the folder of the manifest".into());
        }
        if !self.vocabularies().all(|(file, _)| is_plain(file) && file != Path::new(MANIFEST)) {
            return Some(
                "the file of a descriptor must be a plain file name next to the manifest".into(),
            );
        }
        let mut names: Vec<&Path> = self.files().map(|(file, _)| file).collect();
        names.sort_unstable();
        if names.windows(2).any(|pair| pair[0] == pair[1]) {
            return Some(
                "each file must be named once: file, data.file and those of descriptors".into(),
            );
        }
        if input.multiple == 0 || output.stride == 0 {
            return Some("input.multiple and output.stride must be at least 1".into());
        }
        if !(1..=MAX_CHANNELS).contains(&output.channels) {
            return Some(format!("output.channels must be 1 to {MAX_CHANNELS}"));
        }
        for (edge, pixels) in [("width", input.width), ("height", input.height)] {
            if pixels == 0 || pixels > MAX_EDGE || pixels % input.multiple != 0 {
                let largest = MAX_EDGE - MAX_EDGE % input.multiple;
                let below = (pixels - pixels % input.multiple).min(largest);
                let near = [below, below.saturating_add(input.multiple).min(largest)];
                let mut near: Vec<_> =
                    near.iter().filter(|&&edge| edge > 0).map(u32::to_string).collect();
                near.dedup();
                return Some(format!(
                    "input.{edge} = {pixels} must be a multiple of {} up to {MAX_EDGE}, such as {}",
                    input.multiple,
                    near.join(" or ")
                ));
            }
        }
        if input.multiple % output.stride != 0 {
            return Some("input.multiple must be a multiple of output.stride".into());
        }
        let is_positive = input.std.iter().all(|&s| s > 0.0);
        if !is_positive {
            return Some("input.std must be above 0".into());
        }
        if output.layout == Layout::Map && (output.cls || output.registers > 0) {
            return Some("a map layout has neither a [CLS] token nor registers".into());
        }
        self.kinds_fault()
    }
}
