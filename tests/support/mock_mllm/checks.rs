//! Checks the requests to the mock MLLM as strictly as the real API.

use std::collections::BTreeMap;
use std::sync::Mutex;

use axum::http::{HeaderMap, Uri};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::Value;
use sha2::{Digest, Sha256};

use super::{Purpose, Script};

/// A valid request.
pub struct ParsedCall {
    /// The hashes of its pictures.
    pub pictures: Vec<String>,
    /// The text of its first message.
    pub prompt: String,
    pub repair: bool,
    pub structured: bool,
}

fn ensure(holds: bool, violation: impl Into<String>) -> Result<(), String> {
    if holds { Ok(()) } else { Err(violation.into()) }
}

pub fn check_envelope(uri: &Uri, headers: &HeaderMap, script: &Script) -> Result<(), String> {
    ensure(uri.path() == "/v1/chat/completions", format!("unknown path {}", uri.path()))?;
    let header = |name: &str| headers.get(name).and_then(|value| value.to_str().ok());
    ensure(header("content-type") == Some("application/json"), "content-type is not JSON")?;
    match &script.key {
        Some(key) => {
            let bearer = header("authorization") == Some(&format!("Bearer {key}"));
            ensure(bearer || header("api-key") == Some(key), "no valid key")
        }
        None => Ok(()),
    }
}

pub fn check_request(request: &Value, max_edge: u32) -> Result<ParsedCall, String> {
    const KNOWN: [&str; 6] = [
        "model",
        "messages",
        "temperature",
        "max_tokens",
        "max_completion_tokens",
        "response_format",
    ];
    let fields = request.as_object().ok_or("the body is no object")?;
    for name in fields.keys() {
        ensure(KNOWN.contains(&name.as_str()), format!("unknown field {name}"))?;
    }
    ensure(request["model"].as_str().is_some_and(|model| !model.is_empty()), "no model")?;
    if let Some(temperature) = fields.get("temperature") {
        let right = temperature.as_f64().is_some_and(|t| (0.0..=2.0).contains(&t));
        ensure(right, "temperature is not 0 to 2")?;
    }
    let bounds: Vec<_> = ["max_tokens", "max_completion_tokens"]
        .iter()
        .filter_map(|name| fields.get(*name))
        .collect();
    let bounded =
        bounds.len() <= 1 && bounds.iter().all(|bound| bound.as_u64().is_some_and(|n| n > 0));
    ensure(bounded, "the answer's length must be bounded once at most, by a positive integer")?;
    let structured = fields.get("response_format").map(check_format).transpose()?.is_some();
    let messages = request["messages"].as_array().ok_or("messages is no array")?;
    let mut parsed =
        ParsedCall { pictures: vec![], prompt: String::new(), repair: false, structured };
    let (rules, messages) = match messages.split_first() {
        Some((first, rest)) if first["role"] == "system" => (first["content"].as_str(), rest),
        _ => (None, messages.as_slice()),
    };
    for (index, message) in messages.iter().enumerate() {
        let expected = if index % 2 == 0 { "user" } else { "assistant" };
        ensure(message["role"] == expected, format!("message {index} is not the {expected}'s"))?;
        let text = check_content(&message["content"], max_edge, &mut parsed.pictures)?;
        ensure(!text.trim().is_empty(), format!("message {index} is empty"))?;
        if index == 0 {
            parsed.prompt = [rules.unwrap_or_default(), &text].join("\n");
        }
    }
    ensure(messages.len() % 2 == 1, "the last message is not the user's")?;
    parsed.repair = messages.len() > 1;
    let pictures = parsed.pictures.len();
    ensure(pictures == 0 || pictures == 2, format!("{pictures} pictures"))?;
    ensure(pictures == 0 || !structured, "a describe call with a schema")?;
    Ok(parsed)
}

/// Returns the text, and adds the hashes of the pictures.
fn check_content(
    content: &Value,
    max_edge: u32,
    pictures: &mut Vec<String>,
) -> Result<String, String> {
    if let Some(text) = content.as_str() {
        return Ok(text.to_owned());
    }
    let parts = content.as_array().ok_or("content is neither text nor parts")?;
    let mut text = String::new();
    for part in parts {
        match part["type"].as_str() {
            Some("text") => text.push_str(part["text"].as_str().ok_or("a text part without text")?),
            Some("image_url") => pictures.push(check_picture(&part["image_url"]["url"], max_edge)?),
            other => return Err(format!("a part of type {other:?}")),
        }
    }
    Ok(text)
}

fn check_picture(url: &Value, max_edge: u32) -> Result<String, String> {
    let url = url.as_str().ok_or("an image without a url")?;
    let key: [u8; 32] = Sha256::digest(url.as_bytes()).into();
    let known = CHECKED.lock().unwrap().get(&key).cloned();
    let (longest, hash) = match known {
        Some(known) => known,
        None => {
            let checked = decoded(url)?;
            CHECKED.lock().unwrap().insert(key, checked.clone());
            checked
        }
    };
    ensure(longest <= max_edge, format!("a picture of {longest} pixels"))?;
    Ok(hash)
}

/// What was found out about pictures, by the hash of their URL. A benchmark sends the same ones again and again.
static CHECKED: Mutex<BTreeMap<[u8; 32], (u32, String)>> = Mutex::new(BTreeMap::new());

/// Returns the longest edge of a picture, and its hash.
fn decoded(url: &str) -> Result<(u32, String), String> {
    let data = url.strip_prefix("data:image/jpeg;base64,").ok_or("no data URL of a JPEG")?;
    let bytes = STANDARD.decode(data).map_err(|error| format!("base64: {error}"))?;
    let picture = image::load_from_memory_with_format(&bytes, image::ImageFormat::Jpeg)
        .map_err(|error| format!("the picture cannot be decoded: {error}"))?;
    let longest = picture.width().max(picture.height());
    let hash = Sha256::digest(&bytes).iter().take(8).map(|byte| format!("{byte:02x}")).collect();
    Ok((longest, hash))
}

/// The rules of strict structured output.
fn check_format(format: &Value) -> Result<(), String> {
    if format["type"] == "json_object" {
        return Ok(());
    }
    ensure(format["type"] == "json_schema", "response_format is no json_schema")?;
    let named = &format["json_schema"];
    let name = named["name"].as_str().unwrap_or_default();
    let allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    ensure(!name.is_empty() && name.len() <= 64 && name.chars().all(allowed), "the schema's name")?;
    ensure(named["strict"] == true, "the schema is not strict")?;
    let schema = &named["schema"];
    ensure(schema["type"] == "object", "the schema is no object")?;
    ensure(schema["additionalProperties"] == false, "the schema allows more properties")?;
    let properties = schema["properties"].as_object().ok_or("the schema has no properties")?;
    let required = schema["required"].as_array().ok_or("the schema requires nothing")?;
    let all = properties.keys().all(|name| required.iter().any(|required| required == name));
    ensure(all && required.len() == properties.len(), "not every property is required")
}

/// Decoders write the properties of a schema in the order of its bytes, and reasoning is to come first.
pub fn check_order(body: &[u8]) -> Result<(), String> {
    let body = String::from_utf8_lossy(body);
    match body.split_once("\"properties\":{") {
        Some((_, first)) => ensure(first.starts_with("\"reasoning\""), "the ranking comes first"),
        None => Ok(()),
    }
}

/// What a call is for, by what it contains.
pub fn purpose_of(request: &Value) -> Purpose {
    let text = request["messages"].to_string();
    match (text.contains("Capability check"), text.contains("\"image_url\"")) {
        (true, _) => Purpose::Check,
        (false, true) => Purpose::Describe,
        (false, false) => Purpose::Reason,
    }
}

/// Label and text of all notes in a reasoning prompt.
pub fn notes_in(prompt: &str) -> Vec<(String, String)> {
    let mut notes = Vec::new();
    let mut rest = prompt;
    while let Some((_, from)) = rest.split_once("\n<<<NOTES ") {
        let (head, body) = from.split_once('\n').unwrap();
        let (label, boundary) = head.split_once(' ').unwrap();
        let (text, after) = body.split_once(&format!("\n{boundary} {label} NOTES>>>")).unwrap();
        notes.push((label.to_owned(), text.to_owned()));
        rest = after;
    }
    notes
}
