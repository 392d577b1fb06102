//! The part of the OpenAI chat-completions format that the client uses.

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// The body of a request.
#[derive(Debug, Serialize)]
pub struct ChatRequest<'a> {
    /// The model.
    pub model: &'a str,
    /// The conversation.
    pub messages: &'a [Message],
    /// Sampling temperature.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub temperature: Option<f64>,
    /// The longest answer, in tokens, under its older name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_tokens: Option<u32>,
    /// The longest answer, in tokens, under its newer name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_completion_tokens: Option<u32>,
    /// The schema of the answer.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub response_format: Option<ResponseFormat<'a>>,
}

/// One message of the conversation.
#[derive(Debug, Clone, Serialize)]
pub struct Message {
    /// Its author.
    pub role: Role,
    /// Its content.
    pub content: Content,
}

/// The author of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// This service.
    User,
    /// The model.
    Assistant,
}

/// The content of a message.
#[derive(Debug, Clone, Serialize)]
#[serde(untagged)]
pub enum Content {
    /// Text alone.
    Text(String),
    /// Text and pictures.
    Parts(Vec<Part>),
}

/// A part of a message.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Part {
    /// Text.
    Text {
        /// The text.
        text: String,
    },
    /// A picture.
    ImageUrl {
        /// Its URL.
        image_url: ImageUrl,
    },
}

/// The URL of a picture.
#[derive(Debug, Clone, Serialize)]
pub struct ImageUrl {
    /// A data URL.
    pub url: Arc<str>,
}

/// The JSON schema of an answer.
#[derive(Debug, Clone)]
pub struct Schema {
    /// Its name.
    pub name: &'static str,
    /// The schema.
    pub schema: Value,
}

/// The format of the answer.
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
    /// Returns the schema of an object in which all `properties` are required and no others are allowed, as
    /// strict structured output demands.
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
    /// Creates a message of this service, without pictures.
    pub fn user(text: String) -> Self {
        Self { role: Role::User, content: Content::Text(text) }
    }

    /// Creates a message of the model.
    pub fn assistant(text: String) -> Self {
        Self { role: Role::Assistant, content: Content::Text(text) }
    }

    /// Returns the text of a message without pictures.
    pub fn text(&self) -> &str {
        match &self.content {
            Content::Text(text) => text,
            Content::Parts(_) => "",
        }
    }
}

/// The body of an answer. Unknown fields are ignored.
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

/// Token counts, as the server reports them.
#[derive(Debug, Clone, Copy, Deserialize)]
pub struct TokenUsage {
    /// Tokens sent.
    #[serde(default)]
    pub prompt_tokens: u64,
    /// Tokens received.
    #[serde(default)]
    pub completion_tokens: u64,
}

/// The content of an answer.
#[derive(Debug, Default)]
pub struct Reply {
    /// The text; may be empty.
    pub text: String,
    /// Why the text was cut, if it was.
    pub cut: Option<String>,
    /// The token counts, if the server reports them.
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

/// The body of an error: `{"error": {"message"}}`, or `{"error": "…"}` from some servers.
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
    /// Returns the error message.
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
    fn a_cut_answer_states_the_reason() {
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
