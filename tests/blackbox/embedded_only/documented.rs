//! The examples of the documentation are executed, one after another, on one server.

use std::time::Duration;

use reqwest::multipart::{Form, Part};
use reqwest::{Method, Response};
use serde_json::{Value, json};
use whereabouts_server::http::{Captured, Example, ExampleBody, examples};

use crate::support::{Server, frame, reference, server};

/// The file that recording overwrites.
const FILE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/examples.json");

/// The longest text of a response that is documented.
const LONGEST: usize = 600;

/// The maximum number of documented items of a list.
const MOST: usize = 3;

/// Fields whose text may change, or differs between machines.
const DIFFERS: [&str; 6] = ["text", "reasoning", "detail", "request_id", "provider", "precision"];

/// Fields that background work may have filled in already or not: the calibration of a map, what was read in an
/// image, and attempts at a delivery.
const UNDER_WAY: [&str; 4] = [".calibration", ".texts", ".last_attempt_at", ".last_error"];

/// Lists whose contents depend on the history of the server.
const HAPPENED: [&str; 2] = [".minutes", ".errors"];

fn file(name: &str) -> Vec<u8> {
    match name {
        "gate.jpg" => reference(0),
        "shed.jpg" => reference(1),
        "frame.jpg" => frame(0, 0),
        "notes.txt" => b"no picture".to_vec(),
        other => panic!("no example has a file {other}"),
    }
}

async fn send(
    server: &Server,
    example: &Example,
    captured: &Captured,
    exported: &Value,
) -> Response {
    let method: Method = example.method().parse().unwrap();
    let request = server.request(method, &example.path(captured));
    let request = match &example.body {
        None => request,
        Some(ExampleBody::Json(value)) => {
            request.header("content-type", "application/json").body(value.to_string())
        }
        Some(ExampleBody::JsonFile(_)) => {
            request.header("content-type", "application/json").body(exported["map"].to_string())
        }
        Some(ExampleBody::Picture(name)) => {
            request.header("content-type", "image/jpeg").body(file(name))
        }
        Some(ExampleBody::Form(parts)) => {
            let mut form = Form::new();
            for part in parts {
                let name = part.name.clone();
                form = match part.value.as_str() {
                    Some("<image.json") => {
                        let (map, image) = (&exported["map"], &exported["images"][0]);
                        form.text(name, json!({"map": map, "image": image}).to_string())
                    }
                    Some(path) => {
                        let path = path.strip_prefix('@').unwrap().to_owned();
                        form.part(name, Part::bytes(file(&path)).file_name(path))
                    }
                    None => form.text(name, part.value.to_string()),
                };
            }
            request.multipart(form)
        }
    };
    request.send().await.unwrap()
}

/// The first event of a stream, or the beginning of a text.
async fn beginning(mut response: Response, is_stream: bool) -> String {
    let mut text = String::new();
    let wait = Duration::from_secs(30);
    while let Some(chunk) = tokio::time::timeout(wait, response.chunk()).await.unwrap().unwrap() {
        text += std::str::from_utf8(&chunk).unwrap();
        let events = || text.split_inclusive("\n\n").filter(|event| event.ends_with("\n\n"));
        if is_stream && let Some(event) = events().find(|event| !event.starts_with(':')) {
            return event.trim_end().to_owned();
        }
    }
    let lines = text.split_inclusive('\n');
    let mut beginning = String::new();
    for line in lines.take_while(|line| !line.is_empty()) {
        if beginning.len() + line.len() > LONGEST {
            break;
        }
        beginning += line;
    }
    beginning
}

/// Truncates long texts, such as descriptors, and lists.
fn shortened(value: &mut Value) {
    match value {
        Value::Object(fields) => fields.values_mut().for_each(shortened),
        Value::Array(items) => {
            if items.len() > MOST {
                items.truncate(MOST);
            }
            items.iter_mut().for_each(shortened);
        }
        Value::String(text) if text.len() > LONGEST => {
            let end = (0..40).rev().find(|&at| text.is_char_boundary(at)).unwrap();
            text.truncate(end);
            text.push('…');
        }
        _ => {}
    }
}

/// The kind of a text that differs from server to server.
fn kind(text: &str) -> Option<&'static str> {
    if text.parse::<uuid::Uuid>().is_ok() {
        return Some("an id");
    }
    if text.parse::<jiff::Timestamp>().is_ok() {
        return Some("a moment");
    }
    let hexadecimal = |text: &str| text.len() >= 12 && text.bytes().all(|b| b.is_ascii_hexdigit());
    if text.strip_prefix("sha256:").is_some_and(hexadecimal) || hexadecimal(text) {
        return Some("a digest or the id of a key");
    }
    for (prefix, kind) in
        [("wab_", "a key"), ("whsec_", "a secret"), ("/jobs/", "the address of a job")]
    {
        if text.starts_with(prefix) {
            return Some(kind);
        }
    }
    text.ends_with('…').then_some("a long text")
}

/// Compares a response with the documented one.
fn compare(at: &str, shown: &Value, real: &Value) {
    match (shown, real) {
        (Value::Object(shown), Value::Object(real)) => {
            let keys = |object: &serde_json::Map<String, Value>| {
                object.keys().cloned().collect::<Vec<_>>()
            };
            assert_eq!(keys(shown), keys(real), "{at}");
            for (key, value) in shown {
                compare(&format!("{at}.{key}"), value, &real[key]);
            }
        }
        (Value::Array(shown), Value::Array(real)) => {
            if HAPPENED.iter().any(|list| at.ends_with(list)) {
                return;
            }
            assert!(shown.len() == real.len() || shown.len() == MOST, "{at}: {real:?}");
            for (index, (shown, real)) in shown.iter().zip(real).enumerate() {
                compare(&format!("{at}[{index}]"), shown, real);
            }
        }
        (Value::String(shown), Value::String(real)) => {
            if DIFFERS.iter().any(|word| at.ends_with(word)) {
                return;
            }
            assert_eq!(kind(shown), kind(real), "{at}: {shown} {real}");
            if kind(shown).is_none() {
                assert_eq!(shown, real, "{at}");
            }
        }
        (Value::Number(_), Value::Number(_)) => {}
        (Value::Bool(shown), Value::Bool(real)) => assert_eq!(shown, real, "{at}"),
        (_, Value::Null) | (Value::Null, _) if UNDER_WAY.iter().any(|one| at.ends_with(one)) => {}
        _ => assert_eq!(shown, real, "{at}"),
    }
}

#[tokio::test]
async fn the_documented_examples_are_answered_as_documented() {
    let recording = std::env::var_os("WHEREABOUTS_RECORD_EXAMPLES").is_some();
    let (_dir, server) = server();
    let (mut all, mut captured, mut exported) = (examples().unwrap(), Captured::new(), Value::Null);
    for example in &mut all {
        let at = &format!("{} {}", example.method(), example.path(&captured));
        let sending = send(&server, example, &captured, &exported);
        let is_stream = example.call.ends_with("/events");
        let response = if example.call == "GET /events" {
            let response = sending.await;
            let path = "/localize?map=yard";
            server.post_jpeg(path, frame(0, 1)).await.expect(200);
            response
        } else {
            sending.await
        };
        let status = response.status().as_u16();
        let header = response.headers().get("content-type").map(|value| value.to_str().unwrap());
        let media_type = header.map(|header| header.split(';').next().unwrap().to_owned());
        let json = media_type.as_deref().is_some_and(|of| of.ends_with("json"));
        let mut answer = match &media_type {
            Some(_) if json => Some(response.json::<Value>().await.unwrap()),
            Some(of) if of.starts_with("image/") => None,
            Some(_) => Some(Value::String(beginning(response, is_stream).await)),
            None => None,
        };
        example.capture(answer.as_ref().unwrap_or(&Value::Null), &mut captured);
        if let (true, Some(answer)) = (example.call.ends_with("/export"), &answer) {
            exported = answer.clone();
        }
        answer.as_mut().filter(|_| json).into_iter().for_each(shortened);
        if recording {
            (example.status, example.media_type, example.answer) = (status, media_type, answer);
            continue;
        }
        assert_eq!(
            (status, media_type),
            (example.status, example.media_type.clone()),
            "{at}: {answer:?}"
        );
        match (&example.answer, &answer) {
            (Some(Value::String(shown)), Some(Value::String(real))) => {
                let first = |text: &str| text.lines().next().unwrap_or_default().to_owned();
                assert_eq!(first(shown), first(real), "{at}");
            }
            (Some(shown), Some(real)) => compare(at, shown, real),
            (shown, real) => assert_eq!(shown, real, "{at}"),
        }
    }
    if recording {
        std::fs::write(FILE, format!("{}\n", serde_json::to_string_pretty(&all).unwrap())).unwrap();
    }
}
