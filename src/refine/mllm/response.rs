//! Reads the body of a response, whatever dialect of the chat-completions format it is in.

use serde_json::Value;

use super::error_body::{error_in, plain};
use super::thinking::{Spoken, split};
use super::tokens::Counted;

/// What a response says.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Reply {
    /// The answer, without thinking; may be empty.
    pub text: String,
    /// What the model thought, for people.
    pub thinking: String,
    /// Why the text is not a whole answer, if it is none.
    pub flaw: Option<Flaw>,
    /// The token counts that the server reports.
    pub counted: Counted,
}

/// Why a text is not a whole answer.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Flaw {
    /// It hit the limit on its length.
    #[error(
        "the answer was cut off at its longest length (mllm.max_tokens, or the model's context)"
    )]
    Cut,
    /// The server's filter removed it.
    #[error("the server's content filter held it back")]
    Filtered,
    /// The model refused.
    #[error("the model refused: {0}")]
    Refused(String),
}

/// Why a body is no answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Unreadable {
    /// It is not a chat completion.
    NotChat(String),
    /// It is an error, in spite of the status of success: a code, if it has one, and the server's words.
    Error {
        /// A number like an HTTP status, if the error has one.
        status: Option<u16>,
        /// The whole error as text, for its codes.
        body: String,
        /// The message.
        message: String,
    },
}

/// Characters of a body that is no JSON that are quoted.
const QUOTED: usize = 120;

/// Reads a body.
pub fn read(body: &[u8]) -> Result<Reply, Unreadable> {
    let text = String::from_utf8_lossy(body);
    let start = without_keep_alives(text.trim_start_matches('\u{feff}'));
    // The first value counts: some gateways append the end of a stream.
    let value = match serde_json::Deserializer::from_str(start).into_iter::<Value>().next() {
        Some(Ok(value)) => value,
        other => {
            let error = match other {
                Some(Err(error)) => error.to_string(),
                _ => String::new(),
            };
            streamed(&text).ok_or_else(|| Unreadable::NotChat(no_json(&text, &error)))?
        }
    };
    // Some gateways wrap the answer into a list.
    let value = match value {
        Value::Array(mut items) if items.len() == 1 => items.remove(0),
        value => value,
    };
    if let Some(error) = error_in(&value) {
        return Err(error);
    }
    let Some(choice) = value.get("choices").and_then(|choices| choices.get(0)) else {
        return match value.get("choices") {
            // Nothing was said, which is an answer of its own.
            Some(Value::Array(choices)) if choices.is_empty() => {
                Ok(Reply { counted: Counted::of(value.get("usage")), ..Reply::default() })
            }
            _ => Err(Unreadable::NotChat(not_chat(&value))),
        };
    };
    let Some(message) = choice.get("message").or_else(|| choice.get("delta")) else {
        return match choice.get("text").and_then(Value::as_str) {
            Some(text) => Ok(reply(&value, choice, &Value::Null, text.to_owned())),
            None => Err(Unreadable::NotChat(not_chat(&value))),
        };
    };
    let content = match message.get("content").map(content).unwrap_or_default() {
        text if text.trim().is_empty() => arguments(message).unwrap_or(text),
        text => text,
    };
    Ok(reply(&value, choice, message, content))
}

/// Skips what gateways send to keep a connection alive while the model works: blank lines, and comments of event
/// streams.
fn without_keep_alives(mut text: &str) -> &str {
    loop {
        text = text.trim_start();
        let Some(comment) = text.strip_prefix(':') else { return text };
        text = comment.split_once('\n').map_or("", |(_, rest)| rest);
    }
}

/// Whether a body is a chat completion. For fuzzing.
pub fn is_readable(body: &[u8]) -> bool {
    read(body).is_ok()
}

fn reply(value: &Value, choice: &Value, message: &Value, content: String) -> Reply {
    let Spoken { answer, thinking } = split(&content);
    let aside = ["reasoning_content", "reasoning", "thinking", "reasoning_text"]
        .iter()
        .find_map(|field| message.get(*field).map(self::content).filter(|text| !text.is_empty()));
    let thinking = match aside {
        Some(aside) if thinking.is_empty() => aside,
        Some(aside) => format!("{aside}\n{thinking}"),
        None => thinking,
    };
    let refusal = message.get("refusal").and_then(Value::as_str).map(str::trim);
    let reasons =
        ["finish_reason", "finishReason", "stop_reason", "native_finish_reason", "done_reason"];
    let reason = reasons.iter().filter_map(|field| choice.get(*field).and_then(Value::as_str));
    let reasons: Vec<String> = reason.map(str::to_ascii_lowercase).collect();
    let is = |words: &[&str]| reasons.iter().any(|reason| words.contains(&reason.as_str()));
    let flaw = match refusal.filter(|refusal| !refusal.is_empty()) {
        Some(refusal) => Some(Flaw::Refused(refusal.to_owned())),
        None if is(&[
            "content_filter",
            "safety",
            "recitation",
            "prohibited_content",
            "blocklist",
        ]) =>
        {
            Some(Flaw::Filtered)
        }
        None if is(&["refusal"]) => Some(Flaw::Refused("it gave no reason".to_owned())),
        None if is(&[
            "length",
            "max_tokens",
            "model_length",
            "max_output_tokens",
            "model_context_window_exceeded",
        ]) =>
        {
            Some(Flaw::Cut)
        }
        None => None,
    };
    Reply { text: answer, thinking, flaw, counted: Counted::of(value.get("usage")) }
}

/// The text of a content: a string, parts, or an object with a text. Parts that are thinking are left out.
pub(super) fn content(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Array(parts) => parts.iter().map(content).collect(),
        Value::Object(part) => {
            let kind = part.get("type").and_then(Value::as_str).unwrap_or_default();
            if matches!(kind, "thinking" | "reasoning" | "redacted_thinking") {
                return String::new();
            }
            let text = part.get("text").or_else(|| part.get("content"));
            match text {
                Some(text) => content(text),
                // A model under a schema may answer with the object itself.
                None if kind.is_empty() && !part.is_empty() => value.to_string(),
                None => String::new(),
            }
        }
        _ => String::new(),
    }
}

/// The arguments of a function call: some gateways ask for structured answers in this way.
fn arguments(message: &Value) -> Option<String> {
    let call = message.get("tool_calls").and_then(|calls| calls.get(0));
    let function =
        call.and_then(|call| call.get("function")).or_else(|| message.get("function_call"))?;
    match function.get("arguments")? {
        Value::String(text) => Some(text.clone()),
        arguments => Some(arguments.to_string()),
    }
}

/// Joins the events of a response that is streamed although the request did not ask for that.
fn streamed(text: &str) -> Option<Value> {
    let events = text.lines().filter_map(|line| line.strip_prefix("data:")).map(str::trim);
    let events: Vec<Value> = events.filter_map(|event| serde_json::from_str(event).ok()).collect();
    if events.is_empty() {
        return None;
    }
    if let Some(error) = events.iter().find(|event| error_in(event).is_some()) {
        return Some(error.clone());
    }
    let mut message = serde_json::json!({"content": "", "reasoning_content": ""});
    let (mut finish, mut usage) = (Value::Null, Value::Null);
    for event in &events {
        if let Some(counts) = event.get("usage").filter(|usage| usage.is_object()) {
            usage = counts.clone();
        }
        let Some(choice) = event.get("choices").and_then(|choices| choices.get(0)) else {
            continue;
        };
        let delta = choice.get("delta").or_else(|| choice.get("message")).unwrap_or(&Value::Null);
        for field in ["content", "reasoning_content"] {
            let more = delta.get(field).map(content).unwrap_or_default();
            if let Some(Value::String(text)) = message.get_mut(field) {
                text.push_str(&more);
            }
        }
        if let Some(reason) = choice.get("finish_reason").filter(|reason| reason.is_string()) {
            finish = reason.clone();
        }
    }
    Some(
        serde_json::json!({"choices": [{"message": message, "finish_reason": finish}], "usage": usage}),
    )
}

fn no_json(text: &str, error: &str) -> String {
    let shown: String = plain(text).chars().take(QUOTED).collect();
    match text.trim().is_empty() {
        true => "the body is empty".to_owned(),
        false => format!("{error}; it begins with {shown:?}"),
    }
}

fn not_chat(value: &Value) -> String {
    match value.as_object() {
        Some(fields) => {
            let names: Vec<&str> = fields.keys().map(String::as_str).take(8).collect();
            format!("it has no choices, but {}", names.join(", "))
        }
        None => "it is no JSON object".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn said(body: Value) -> Reply {
        read(body.to_string().as_bytes()).unwrap()
    }

    #[test]
    fn an_answer_is_read_from_every_dialect() {
        let message = |message: Value| said(json!({"choices": [{"message": message}]})).text;
        assert_eq!(message(json!({"content": "a wall"})), "a wall");
        assert_eq!(
            message(json!({"content": [{"type": "text", "text": "a "}, {"text": "wall"}]})),
            "a wall"
        );
        let parts =
            json!([{"type": "thinking", "thinking": "hm"}, {"type": "text", "text": "a wall"}]);
        assert_eq!(message(json!({"content": parts})), "a wall");
        assert_eq!(message(json!({"content": {"ranking": ["A"]}})), r#"{"ranking":["A"]}"#);
        assert_eq!(message(json!({"content": null})), "");
        let call = json!([{"function": {"name": "f", "arguments": "{\"ranking\": []}"}}]);
        assert_eq!(message(json!({"content": null, "tool_calls": call})), "{\"ranking\": []}");
        assert_eq!(said(json!({"choices": []})).text, "");
        assert_eq!(said(json!({"choices": [{"text": "a wall"}]})).text, "a wall");
        assert_eq!(said(json!([{"choices": [{"message": {"content": "a"}}]}])).text, "a");
        let events = "data: {\"choices\":[{\"delta\":{\"content\":\"a \"}}]}\n\ndata: \
                      {\"choices\":[{\"delta\":{\"content\":\"wall\"},\"finish_reason\":\"length\"}]}\n\ndata: [DONE]\n";
        let reply = read(events.as_bytes()).unwrap();
        assert_eq!((reply.text.as_str(), reply.flaw), ("a wall", Some(Flaw::Cut)));
    }

    #[test]
    fn thinking_is_kept_apart() {
        let reply = said(json!({"choices": [{"message": {
            "content": "<think>one</think>answer", "reasoning_content": "two"
        }}]}));
        assert_eq!((reply.text.as_str(), reply.thinking.as_str()), ("answer", "two\none"));
    }

    #[test]
    fn a_flawed_answer_says_so() {
        let flaw = |choice: Value| said(json!({"choices": [choice]})).flaw;
        let message = json!({"content": "x"});
        assert_eq!(flaw(json!({"message": message, "finish_reason": "length"})), Some(Flaw::Cut));
        assert_eq!(
            flaw(json!({"message": message, "finish_reason": "content_filter"})),
            Some(Flaw::Filtered)
        );
        let refused = json!({"message": {"content": null, "refusal": "no"}});
        assert_eq!(flaw(refused), Some(Flaw::Refused("no".into())));
        assert_eq!(flaw(json!({"message": message, "finish_reason": "stop"})), None);
    }

    #[test]
    fn what_is_no_chat_completion_says_what_it_is() {
        for (body, told) in [
            ("", "empty"),
            ("<html><title>502 Bad Gateway</title></html>", "502 Bad Gateway"),
            ("{\"models\": []}", "no choices, but models"),
            ("7", "no JSON object"),
        ] {
            let Err(Unreadable::NotChat(why)) = read(body.as_bytes()) else { panic!("{body}") };
            assert!(why.contains(told), "{why}");
        }
    }
}
