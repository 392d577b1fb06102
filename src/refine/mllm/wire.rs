//! The request of the OpenAI chat-completions format.

use std::sync::Arc;

use serde::Serialize;

use super::schema::ResponseFormat;

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
    /// The format of the answer.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub response_format: Option<ResponseFormat>,
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
    /// This service, with rules that hold for the whole conversation.
    System,
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

impl Part {
    /// Creates a part of text.
    pub fn text(text: &str) -> Self {
        Self::Text { text: text.to_owned() }
    }

    /// Creates a part with a picture.
    pub fn picture(url: &Arc<str>) -> Self {
        Self::ImageUrl { image_url: ImageUrl { url: Arc::clone(url) } }
    }
}

impl Message {
    /// Creates a message with rules.
    pub fn system(text: String) -> Self {
        Self { role: Role::System, content: Content::Text(text) }
    }

    /// Creates a message of this service, without pictures.
    pub fn user(text: String) -> Self {
        Self { role: Role::User, content: Content::Text(text) }
    }

    /// Creates a message of this service, with pictures.
    pub fn parts(parts: Vec<Part>) -> Self {
        Self { role: Role::User, content: Content::Parts(parts) }
    }

    /// Creates a message of the model.
    pub fn assistant(text: String) -> Self {
        Self { role: Role::Assistant, content: Content::Text(text) }
    }

    /// Returns the text of a message, without its pictures.
    pub fn text(&self) -> String {
        match &self.content {
            Content::Text(text) => text.clone(),
            Content::Parts(parts) => {
                let texts = parts.iter().filter_map(|part| match part {
                    Part::Text { text } => Some(text.as_str()),
                    Part::ImageUrl { .. } => None,
                });
                texts.collect::<Vec<_>>().join("\n")
            }
        }
    }
}

/// Moves the rules into the first message of the user, for servers that take no system message.
pub fn without_system(messages: &[Message]) -> Vec<Message> {
    let mut rules = String::new();
    let mut merged: Vec<Message> = Vec::with_capacity(messages.len());
    for message in messages {
        if message.role == Role::System {
            rules.push_str(&message.text());
            rules.push_str("\n\n");
            continue;
        }
        let mut message = message.clone();
        if message.role == Role::User && !rules.is_empty() {
            let rules = std::mem::take(&mut rules);
            message.content = match message.content {
                Content::Text(text) => Content::Text(rules + &text),
                Content::Parts(mut parts) => {
                    parts.insert(0, Part::Text { text: rules });
                    Content::Parts(parts)
                }
            };
        }
        merged.push(message);
    }
    merged
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rules_move_into_the_first_message_of_the_user() {
        let text = [Message::system("rules".into()), Message::user("notes".into())];
        let merged = without_system(&text);
        assert_eq!((merged.len(), merged[0].text().as_str()), (1, "rules\n\nnotes"));
        let parts =
            [Message::system("rules".into()), Message::parts(vec![Part::picture(&"data:".into())])];
        let merged = without_system(&parts);
        assert!(matches!(&merged[0].content, Content::Parts(parts) if parts.len() == 2));
    }
}
