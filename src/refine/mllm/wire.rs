//! The OpenAI chat-completions format, as far as it is used here.

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// The body of a request.
#[derive(Debug, Serialize)]
pub struct ChatRequest<'a> {
    /// Who is to answer.
    pub model: &'a str,
    /// What is said.
    pub messages: &'a [Message],
    /// Sampling.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub temperature: Option<f64>,
    /// The longest answer, in tokens, under its older name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_tokens: Option<u32>,
    /// The longest answer, in tokens, under its newer name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_completion_tokens: Option<u32>,
    /// The shape of the answer.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub response_format: Option<ResponseFormat<'a>>,
}

/// One turn of the conversation.
#[derive(Debug, Clone, Serialize)]
pub struct Message {
    /// Who speaks.
    pub role: Role,
    /// What is said.
    pub content: Content,
}

/// Who speaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// This service.
    User,
    /// The model.
    Assistant,
}

/// What is said.
#[derive(Debug, Clone, Serialize)]
#[serde(untagged)]
pub enum Content {
    /// Text alone.
    Text(String),
    /// Text and pictures.
    Parts(Vec<Part>),
}

/// A piece of a message.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Part {
    /// Text.
    Text {
        /// It.
        text: String,
    },
    /// A picture.
    ImageUrl {
        /// Where it is.
        image_url: ImageUrl,
    },
}

/// Where a picture is.
#[derive(Debug, Clone, Serialize)]
pub struct ImageUrl {
    /// A data URL.
    pub url: Arc<str>,
}

/// A JSON schema that the answer is to follow.
#[derive(Debug, Clone)]
pub struct Schema {
    /// Its name.
    pub name: &'static str,
    /// It.
    pub schema: Value,
}

/// The shape of the answer.
#[derive(Debug, Serialize)]
pub struct ResponseFormat<'a> {
    #[serde(rename = "type")]
    kind: &'static str,
    json_schema: JsonSchema<'a>,
}

#[derive(Debug, Serialize)]
struct JsonSchema<'a> {
    name: &'a str,
    strict: bool,
    schema: &'a Value,
}

impl<'a> From<&'a Schema> for ResponseFormat<'a> {
    fn from(schema: &'a Schema) -> Self {
        let json_schema = JsonSchema { name: schema.name, strict: true, schema: &schema.schema };
        Self { kind: "json_schema", json_schema }
    }
}

impl Schema {
    /// An object in which every one of `properties` is required and no other is allowed, as strict
    /// structured output demands.
    pub fn object(name: &'static str, properties: Value) -> Self {
        let required: Vec<&String> =
            properties.as_object().map(|fields| fields.keys().collect()).unwrap_or_default();
        let schema = json!({
            "type": "object",
            "required": required,
            "properties": properties,
            "additionalProperties": false,
        });
        Self { name, schema }
    }
}

impl Message {
    /// What this service says, without pictures.
    pub fn user(text: String) -> Self {
        Self { role: Role::User, content: Content::Text(text) }
    }

    /// What the model said.
    pub fn assistant(text: String) -> Self {
        Self { role: Role::Assistant, content: Content::Text(text) }
    }

    /// The text of a message without pictures.
    pub fn text(&self) -> &str {
        match &self.content {
            Content::Text(text) => text,
            Content::Parts(_) => "",
        }
    }
}

/// The body of an answer. Whatever else it holds is left aside.
#[derive(Debug, Deserialize)]
pub struct ChatAnswer {
    choices: Vec<Choice>,
    #[serde(default)]
    usage: Option<TokenUsage>,
}

#[derive(Debug, Deserialize)]
struct Choice {
    message: AnswerMessage,
    #[serde(default)]
    finish_reason: Option<String>,
}

#[derive(Debug, Deserialize)]
struct AnswerMessage {
    #[serde(default)]
    content: Option<AnswerContent>,
    #[serde(default)]
    refusal: Option<String>,
}

#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum AnswerContent {
    Text(String),
    Parts(Vec<AnswerPart>),
}

#[derive(Debug, Deserialize)]
struct AnswerPart {
    #[serde(default)]
    text: String,
}

/// Tokens, as the server counts them.
#[derive(Debug, Clone, Copy, Deserialize)]
pub struct TokenUsage {
    /// Tokens sent.
    #[serde(default)]
    pub prompt_tokens: u64,
    /// Tokens received.
    #[serde(default)]
    pub completion_tokens: u64,
}

/// What an answer comes to.
#[derive(Debug, Default)]
pub struct Reply {
    /// What the model said; may be empty.
    pub text: String,
    /// Why there is no more of it, where that is not the usual end.
    pub cut: Option<String>,
    /// What it cost, if the server tells.
    pub usage: Option<TokenUsage>,
}

impl From<ChatAnswer> for Reply {
    fn from(answer: ChatAnswer) -> Self {
        let usage = answer.usage;
        let Some(Choice { message, finish_reason }) = answer.choices.into_iter().next() else {
            return Self { usage, ..Self::default() };
        };
        let text = match message.content {
            Some(AnswerContent::Text(text)) => text,
            Some(AnswerContent::Parts(parts)) => parts.into_iter().map(|part| part.text).collect(),
            None => String::new(),
        };
        let cut = match (message.refusal, finish_reason.as_deref()) {
            (Some(refusal), _) => Some(format!("the model refused: {refusal}")),
            (None, Some("length")) => Some("the answer hit mllm.max_tokens".to_owned()),
            (None, Some("content_filter")) => Some("the server's content filter".to_owned()),
            (None, _) => None,
        };
        Self { text, cut, usage }
    }
}

/// The bodies of a refusal: `{"error": {"message"}}`, or `{"error": "…"}` as some servers have it.
#[derive(Debug, Deserialize)]
pub struct ErrorAnswer {
    error: ErrorDetail,
}

#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum ErrorDetail {
    Text(String),
    Object { message: String },
}

impl ErrorAnswer {
    /// What the server says.
    pub fn message(self) -> String {
        match self.error {
            ErrorDetail::Text(message) | ErrorDetail::Object { message } => message,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reply(body: Value) -> Reply {
        serde_json::from_value::<ChatAnswer>(body).unwrap().into()
    }

    #[test]
    fn an_answer_is_text_or_parts_of_text() {
        let text = |content: Value| reply(json!({"choices": [{"message": {"content": content}}]}));
        assert_eq!(text(json!("a wall")).text, "a wall");
        assert_eq!(text(json!([{"type": "text", "text": "a "}, {"text": "wall"}])).text, "a wall");
        assert_eq!(text(Value::Null).text, "");
        assert_eq!(reply(json!({"choices": []})).text, "");
    }

    #[test]
    fn an_answer_says_why_it_is_cut() {
        let body = json!({"choices": [{"message": {"content": ""}, "finish_reason": "length"}]});
        assert!(reply(body).cut.unwrap().contains("mllm.max_tokens"));
        let body = json!({"choices": [{"message": {"content": null, "refusal": "no"}}]});
        assert!(reply(body).cut.unwrap().contains("refused: no"));
    }

    #[test]
    fn a_schema_requires_every_property() {
        let schema = Schema::object("s", json!({"a": {"type": "string"}, "b": {"type": "array"}}));
        assert_eq!(schema.schema["required"], json!(["a", "b"]));
        assert_eq!(schema.schema["additionalProperties"], false);
    }
}
