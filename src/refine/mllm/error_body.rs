//! Errors in the bodies of responses: those of a status of failure, and those in spite of a status of success.

use serde_json::Value;

use super::response::{Unreadable, content};

/// Returns the error in a body. Gateways report errors of the model's server in this way.
pub(super) fn error_in(value: &Value) -> Option<Unreadable> {
    let in_choice = || {
        let choice = value.get("choices")?.get(0)?;
        let said = choice.pointer("/message/content").map(content).unwrap_or_default();
        choice.get("error").filter(|_| said.is_empty())
    };
    let no_choice = value.get("choices").is_none_or(|choices| choices.get(0).is_none());
    let says_error = |value: &Value| {
        let is = |field: &str, word: &str| value.get(field).and_then(Value::as_str) == Some(word);
        is("object", "error")
            || is("type", "error")
            || value.get("success") == Some(&Value::Bool(false))
    };
    if let Some(broken) = broken_off(value) {
        return Some(broken);
    }
    let error = match value.get("error").filter(|error| !error.is_null() && no_choice) {
        Some(error) => error,
        None if says_error(value) && no_choice => value,
        None => {
            let detail = ["detail", "message", "error_message", "errorMessage", "base_resp", "msg"];
            let is_told = no_choice && value.get("choices").is_none_or(Value::is_null);
            let told = detail.iter().find_map(|field| value.get(*field).filter(|_| is_told));
            match in_choice() {
                Some(error) => error,
                None => told.map(|_| value)?,
            }
        }
    };
    Some(Unreadable::Error {
        status: status_in(error),
        body: value.to_string(),
        message: message_of(value),
    })
}

/// Some gateways end an answer in this way when the model's server fails.
fn broken_off(value: &Value) -> Option<Unreadable> {
    let reason = value.pointer("/choices/0/finish_reason").and_then(Value::as_str)?;
    matches!(reason, "error" | "network_error" | "abort").then(|| Unreadable::Error {
        status: value.pointer("/choices/0/error").and_then(status_in),
        body: value.to_string(),
        message: match value.pointer("/choices/0/error") {
            Some(error) => message_of(error),
            None => format!("the answer broke off (finish_reason {reason})"),
        },
    })
}

fn status_in(error: &Value) -> Option<u16> {
    let fields = ["code", "status", "status_code", "error_code"];
    fields.iter().find_map(|field| {
        let number = match error.get(*field)? {
            Value::Number(number) => number.as_u64()?,
            Value::String(text) => text.parse().ok()?,
            _ => return None,
        };
        u16::try_from(number).ok().filter(|number| (400..600).contains(number))
    })
}

/// Returns the message of an error: `{"error": {"message"}}`, `{"error": "…"}`, `[{"error": …}]`, `{"detail"}`, …
pub fn error_message(body: &[u8]) -> String {
    match serde_json::from_slice::<Value>(body) {
        Ok(value) => message_of(&value),
        Err(_) => plain(&String::from_utf8_lossy(body)),
    }
}

fn message_of(value: &Value) -> String {
    const FIELDS: [&str; 10] = [
        "message",
        "error",
        "detail",
        "details",
        "error_message",
        "errorMessage",
        "msg",
        "status_msg",
        "base_resp",
        "title",
    ];
    match value {
        Value::String(text) => match serde_json::from_str::<Value>(text) {
            Ok(inner @ (Value::Object(_) | Value::Array(_))) => message_of(&inner),
            _ => text.clone(),
        },
        Value::Array(items) => items.first().map(message_of).unwrap_or_default(),
        Value::Object(fields) => {
            let known = FIELDS.iter().filter_map(|field| fields.get(*field));
            let mut told = known.filter(|value| !value.is_null()).map(message_of);
            let in_choice = value.pointer("/choices/0/error").map(message_of);
            let message = told
                .find(|text| !text.is_empty())
                .or(in_choice)
                .unwrap_or_else(|| value.to_string());
            let message = match fields.get("loc").and_then(Value::as_array) {
                // The field of the request that is wrong.
                Some(path) => {
                    let path: Vec<String> = path.iter().map(message_of).collect();
                    format!("{}: {message}", path.join("."))
                }
                None => message,
            };
            // Gateways keep the words of the model's server here.
            match value.pointer("/metadata/raw").and_then(Value::as_str) {
                Some(raw) => format!("{message}: {}", message_of(&Value::String(raw.to_owned()))),
                None => message,
            }
        }
        other => other.to_string(),
    }
}

/// Returns a page's title, or else its text.
pub(super) fn plain(text: &str) -> String {
    let lower = text.to_ascii_lowercase();
    let title = || {
        let begins = lower.find("<title>")? + "<title>".len();
        let ends = lower[begins..].find("</title>")? + begins;
        Some(text[begins..ends].trim().to_owned())
    };
    title().unwrap_or_else(|| text.to_owned())
}

#[cfg(test)]
mod tests {
    use super::super::response::read;
    use super::*;
    use serde_json::json;

    #[test]
    fn an_error_in_a_body_is_no_answer() {
        for (body, status, message) in [
            (json!({"error": {"message": "no credits", "code": 402}}), Some(402), "no credits"),
            (json!({"error": "model not found"}), None, "model not found"),
            (json!([{"error": {"code": 400, "message": "bad"}}]), Some(400), "bad"),
            (json!({"object": "error", "message": "too long", "code": 400}), Some(400), "too long"),
            (json!({"choices": null, "error": {"message": "down"}}), None, "down"),
            (json!({"detail": "Not Found"}), None, "Not Found"),
            (
                json!({"choices": [{"error": {"message": "upstream", "code": 502}, "message": {"content": ""}}]}),
                Some(502),
                "upstream",
            ),
        ] {
            let error = read(body.to_string().as_bytes()).unwrap_err();
            let Unreadable::Error { status: found, message: told, .. } = error else {
                panic!("{body}: {error:?}")
            };
            assert_eq!((found, told.as_str()), (status, message), "{body}");
        }
    }

    #[test]
    fn the_message_of_an_error_is_found_in_every_dialect() {
        for (body, message) in [
            (r#"{"error": {"message": "no key"}}"#, "no key"),
            (r#"[{"error": {"code": 400, "message": "bad"}}]"#, "bad"),
            (r#"{"detail": [{"msg": "field required"}]}"#, "field required"),
            (r#"{"detail": [{"loc": ["body", "top_k"], "msg": "no"}]}"#, "body.top_k: no"),
            (r#"{"type": "error", "error": {"type": "x", "message": "overloaded"}}"#, "overloaded"),
            (
                r#"{"error": {"message": "Provider returned error", "metadata": {"raw": "{\"error\":{\"message\":\"too big\"}}"}}}"#,
                "Provider returned error: too big",
            ),
            ("<html><head><title>413 Too Large</title></head></html>", "413 Too Large"),
            ("plain words", "plain words"),
        ] {
            assert_eq!(error_message(body.as_bytes()), message, "{body}");
        }
    }
}
