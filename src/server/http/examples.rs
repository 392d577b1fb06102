//! An example of each call, for its description. The tests execute all of them
//! (`tests/blackbox/embedded_only/documented.rs`), and write the answers of `docs/examples.json`.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use utoipa::openapi::extensions::ExtensionsBuilder;
use utoipa::openapi::path::Operation;
use utoipa::openapi::{OpenApi, RefOr};

/// All examples, in an order in which they can be executed.
const EXAMPLES: &str = include_str!("../../../docs/examples.json");

/// A request with its expected answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Example {
    /// Method and route, as in the description.
    pub call: String,
    /// Path and query of the request. A name in braces stands for a value from an earlier answer.
    pub path: String,
    /// The body of the request.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub body: Option<ExampleBody>,
    /// The status of the answer.
    pub status: u16,
    /// The media type of the answer; none without a body.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub media_type: Option<String>,
    /// The answer: JSON, or the beginning of a text; none of a picture.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub answer: Option<Value>,
    /// Values that later requests use: by name, the JSON pointer (RFC 6901) into the answer.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub takes: BTreeMap<String, String>,
}

/// Values from earlier answers, by name.
pub type Captured = BTreeMap<String, String>;

/// The body of a request.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ExampleBody {
    /// JSON.
    Json(Value),
    /// The JSON in a file.
    JsonFile(String),
    /// The picture in a file.
    Picture(String),
    /// A form.
    Form(Vec<ExamplePart>),
}

/// A part of a form.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExamplePart {
    /// Its name.
    pub name: String,
    /// Its value: JSON, `@` and the name of a file to send, or `<` and the name of a file whose text is the value.
    pub value: Value,
}

/// All examples, in an order in which they can be executed.
pub fn examples() -> Result<Vec<Example>, serde_json::Error> {
    serde_json::from_str(EXAMPLES)
}

impl Example {
    /// The method of the request.
    pub fn method(&self) -> &str {
        self.call.split(' ').next().unwrap_or_default()
    }

    /// The path with captured values filled in.
    pub fn path(&self, captured: &Captured) -> String {
        let fill = |path: String, (name, value): (&String, &String)| {
            path.replace(&format!("{{{name}}}"), value)
        };
        captured.iter().fold(self.path.clone(), fill)
    }

    /// Captures from an answer what later requests need.
    pub fn capture(&self, answer: &Value, captured: &mut Captured) {
        for (name, pointer) in &self.takes {
            let value = answer.pointer(pointer).and_then(Value::as_str);
            captured.insert(name.clone(), value.unwrap_or_default().to_owned());
        }
    }

    /// The request as a curl command line.
    fn curl(&self, captured: &Captured) -> String {
        let mut command = "curl".to_owned();
        let implied = if self.body.is_some() { "POST" } else { "GET" };
        if self.method() != implied {
            command += &format!(" -X {}", self.method());
        }
        match &self.body {
            None => {}
            Some(ExampleBody::Json(value)) => {
                let _ = write!(command, " -H 'Content-Type: application/json' -d '{value}'");
            }
            Some(ExampleBody::JsonFile(file)) => {
                let _ = write!(command, " -H 'Content-Type: application/json' -d @{file}");
            }
            Some(ExampleBody::Picture(file)) => {
                let _ = write!(command, " -H 'Content-Type: image/jpeg' --data-binary @{file}");
            }
            Some(ExampleBody::Form(parts)) => {
                for ExamplePart { name, value } in parts {
                    let _ = match value.as_str() {
                        Some(file) => write!(command, " -F {name}={file}"),
                        None => write!(command, " -F '{name}={value}'"),
                    };
                }
            }
        }
        let _ = write!(command, " 'http://localhost:8080{}'", self.path(captured));
        command
    }
}

/// Adds the examples to their calls.
pub(super) fn show(description: &mut OpenApi) {
    let examples = match examples() {
        Ok(examples) => examples,
        Err(error) => return tracing::error!(%error, "there are no examples in the description"),
    };
    let mut captured = Captured::new();
    for example in &examples {
        example.capture(example.answer.as_ref().unwrap_or(&Value::Null), &mut captured);
    }
    for (route, item) in &mut description.paths.paths {
        let operations = [
            ("GET", &mut item.get),
            ("PUT", &mut item.put),
            ("POST", &mut item.post),
            ("PATCH", &mut item.patch),
            ("DELETE", &mut item.delete),
        ];
        for (method, operation) in operations {
            let Some(operation) = operation else { continue };
            let call = format!("{method} {route}");
            let of_call: Vec<_> = examples.iter().filter(|example| example.call == call).collect();
            of_call.iter().rev().for_each(|example| show_one(operation, example));
            let typed: Vec<_> = of_call
                .iter()
                .map(|example| json!({"lang": "curl", "source": example.curl(&captured)}))
                .collect();
            let extension = ExtensionsBuilder::new().add("x-codeSamples", typed).build();
            operation.extensions = Some(extension);
        }
    }
}

fn show_one(operation: &mut Operation, example: &Example) {
    if let (Some(ExampleBody::Json(value)), Some(RefOr::T(body))) =
        (&example.body, &mut operation.request_body)
        && let Some(RefOr::T(content)) = body.content.get_mut("application/json")
    {
        content.example = Some(value.clone());
    }
    if let (Some(media_type), Some(answer)) = (&example.media_type, &example.answer)
        && let Some(RefOr::T(response)) =
            operation.responses.responses.get_mut(&example.status.to_string())
        && let Some(RefOr::T(content)) = response.content.get_mut(media_type.as_str())
    {
        content.example = Some(answer.clone());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_described_call_has_an_example_of_a_described_answer() {
        let examples = examples().unwrap();
        let description = serde_json::to_value(super::super::openapi()).unwrap();
        let mut calls = Vec::new();
        for (route, methods) in description["paths"].as_object().unwrap() {
            for (method, operation) in methods.as_object().unwrap() {
                let call = format!("{} {route}", method.to_uppercase());
                let of_call = examples.iter().filter(|example| example.call == call);
                let statuses: Vec<_> = of_call.map(|example| example.status.to_string()).collect();
                assert!(!statuses.is_empty(), "{call} has no example");
                for status in statuses {
                    let response = &operation["responses"][&status];
                    assert!(response.is_object(), "{call} does not describe {status}");
                    let shown = response.to_string().contains("\"example\":");
                    assert!(
                        shown || response["content"]["image/jpeg"].is_object() || status == "204",
                        "{call}"
                    );
                }
                assert!(
                    operation["x-codeSamples"][0]["source"].as_str().unwrap().starts_with("curl ")
                );
                calls.push(call);
            }
        }
        assert!(examples.iter().all(|example| calls.contains(&example.call)));
    }
}
