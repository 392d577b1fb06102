//! The calls by which a check finds out what a server can do. Each says in its text what it is.

use image::{Rgb, RgbImage};
use whereabouts_vision::decode::encode_jpeg;

use super::client::{Call, MllmClient};
use super::labels::Labels;
use super::pictures::data_url;
use super::tokens::estimate;
use super::wire::{Message, Part};

/// The longest edge of the pictures, in pixels.
const EDGE: u32 = 64;

/// Returns a call that shows this many pictures.
pub(super) fn picture_call<'a>(client: &MllmClient, model: &'a str, pictures: u32) -> Call<'a> {
    let question =
        "Capability check: how many pictures are there above? Answer with the number alone.";
    let mut parts: Vec<Part> = (0..pictures).filter_map(picture).collect();
    parts.push(Part::text(question));
    let message = match pictures {
        0 => Message::user(question.to_owned()),
        _ => Message::parts(parts),
    };
    let rules =
        Message::system("You answer capability checks in as few words as possible.".to_owned());
    Call {
        model,
        messages: vec![rules, message],
        shorter: None,
        labels: None,
        prompt_tokens: 60 + 300 * u64::from(pictures),
        max_tokens: client.max_tokens(),
    }
}

/// Returns a call that asks for a ranking of two candidates.
pub(super) fn ranking_call<'a>(
    client: &MllmClient,
    model: &'a str,
    labels: &'a Labels,
) -> Call<'a> {
    let question = "Capability check: candidate A shows the very place of the frame, candidate B another one. \
                    Rank both. Answer with one JSON object and nothing else: {\"reasoning\": \"why, in a few \
                    words\", \"ranking\": [\"the likelier label\", \"the other\"], \"certainty\": \"certain, \
                    likely, unsure or none\"}";
    Call {
        model,
        messages: vec![
            Message::system("You rank candidates by likelihood.".to_owned()),
            Message::user(question.to_owned()),
        ],
        shorter: None,
        labels: Some(labels.names()),
        prompt_tokens: estimate(question) + 20,
        max_tokens: client.max_tokens(),
    }
}

/// Draws a picture of one colour with a square of another.
fn picture(number: u32) -> Option<Part> {
    let square = |x: u32, y: u32| (16..48).contains(&x) && (16..48).contains(&y);
    let shade = if number == 0 { Rgb([200, 40, 40]) } else { Rgb([40, 40, 200]) };
    let pixel = |x, y| if square(x, y) { shade } else { Rgb([230, 230, 230]) };
    let jpeg = encode_jpeg(&RgbImage::from_fn(EDGE, EDGE, pixel)).ok()?;
    Some(Part::picture(&data_url(&jpeg)))
}
