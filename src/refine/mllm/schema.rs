//! The schema of the reasoning model's answer, in the order in which the model is to write it.
//!
//! Decoders that follow a schema write its properties in the order of the request's bytes: reasoning comes first,
//! so that the ranking follows from it.

use serde::Serialize;

use whereabouts_core::Certainty;

/// The format that a request asks for.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum ResponseFormat {
    /// An answer that follows a schema.
    JsonSchema {
        /// The schema with its name.
        json_schema: Box<NamedSchema>,
    },
    /// Any JSON object.
    JsonObject,
}

/// A schema with its name.
#[derive(Debug, Clone, Serialize)]
pub struct NamedSchema {
    name: &'static str,
    strict: bool,
    schema: RankingSchema,
}

#[derive(Debug, Clone, Serialize)]
#[serde(rename_all = "camelCase")]
struct RankingSchema {
    r#type: &'static str,
    properties: Properties,
    required: [&'static str; 3],
    additional_properties: bool,
}

/// In the order of thought.
#[derive(Debug, Clone, Serialize)]
struct Properties {
    reasoning: Text,
    ranking: List,
    certainty: OneOf<Certainty>,
}

#[derive(Debug, Clone, Serialize)]
struct Text {
    r#type: &'static str,
}

#[derive(Debug, Clone, Serialize)]
#[serde(rename_all = "camelCase")]
struct List {
    r#type: &'static str,
    items: OneOf<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    min_items: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    max_items: Option<usize>,
}

#[derive(Debug, Clone, Serialize)]
struct OneOf<T> {
    r#type: &'static str,
    r#enum: Vec<T>,
}

/// How a server is asked for the format of an answer, the strictest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum AnswerFormat {
    /// A schema with the number of labels.
    BoundedSchema,
    /// A schema without it.
    Schema,
    /// Any JSON object.
    JsonObject,
    /// The prompt alone asks.
    Text,
}

impl AnswerFormat {
    /// All formats.
    pub const ALL: [Self; 4] = [Self::BoundedSchema, Self::Schema, Self::JsonObject, Self::Text];

    /// Returns its name in the API.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::BoundedSchema => "bounded_schema",
            Self::Schema => "schema",
            Self::JsonObject => "json_object",
            Self::Text => "text",
        }
    }

    /// Returns the next less strict format.
    pub fn weaker(self) -> Option<Self> {
        Self::ALL.into_iter().find(|format| *format > self)
    }

    /// Returns the field of a request.
    pub fn of(self, labels: &[String]) -> Option<ResponseFormat> {
        match self {
            Self::BoundedSchema => Some(schema(labels, Some(labels.len()))),
            Self::Schema => Some(schema(labels, None)),
            Self::JsonObject => Some(ResponseFormat::JsonObject),
            Self::Text => None,
        }
    }
}

fn schema(labels: &[String], count: Option<usize>) -> ResponseFormat {
    let ranking = List {
        r#type: "array",
        items: OneOf { r#type: "string", r#enum: labels.to_vec() },
        min_items: count,
        max_items: count,
    };
    let certainty = OneOf {
        r#type: "string",
        r#enum: vec![Certainty::Certain, Certainty::Likely, Certainty::Unsure, Certainty::None],
    };
    let schema = RankingSchema {
        r#type: "object",
        properties: Properties { reasoning: Text { r#type: "string" }, ranking, certainty },
        required: ["reasoning", "ranking", "certainty"],
        additional_properties: false,
    };
    ResponseFormat::JsonSchema {
        json_schema: Box::new(NamedSchema { name: "ranking", strict: true, schema }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasoning_comes_before_the_ranking_in_the_bytes() {
        let labels = ["A".to_owned(), "B".to_owned()];
        let bytes = serde_json::to_string(&AnswerFormat::BoundedSchema.of(&labels)).unwrap();
        assert_eq!(
            bytes,
            r#"{"type":"json_schema","json_schema":{"name":"ranking","strict":true,"schema":{"type":"object","properties":{"reasoning":{"type":"string"},"ranking":{"type":"array","items":{"type":"string","enum":["A","B"]},"minItems":2,"maxItems":2},"certainty":{"type":"string","enum":["certain","likely","unsure","none"]}},"required":["reasoning","ranking","certainty"],"additionalProperties":false}}}"#
        );
        let plain = serde_json::to_string(&AnswerFormat::Schema.of(&labels)).unwrap();
        assert!(plain.contains(r#""strict":true"#) && !plain.contains("Items"));
    }

    #[test]
    fn formats_weaken_step_by_step() {
        let mut format = AnswerFormat::BoundedSchema;
        let mut steps = 0;
        while let Some(weaker) = format.weaker() {
            format = weaker;
            steps += 1;
        }
        assert_eq!((format, steps), (AnswerFormat::Text, 3));
        assert!(format.of(&[]).is_none());
    }
}
