//! What servers tell about themselves, each kind in its own words.

use serde_json::Value;

/// What a server tells about itself.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Facts {
    /// The length of the context of one call, in tokens.
    pub context: Option<u64>,
    /// How many calls it works on at once.
    pub slots: Option<usize>,
    /// Whether it lists the model.
    pub is_model_listed: Option<bool>,
}

impl Facts {
    /// Takes what is missing here from other facts, whose context counts if it is shorter.
    pub fn or(self, other: Self) -> Self {
        Self {
            context: match (self.context, other.context) {
                (Some(one), Some(other)) => Some(one.min(other)),
                (one, other) => one.or(other),
            },
            slots: self.slots.or(other.slots),
            is_model_listed: self.is_model_listed.or(other.is_model_listed),
        }
    }
}

/// Fields in which lists of models have the context: vLLM, OpenRouter, Groq, LM Studio, llama.cpp.
const CONTEXT_FIELDS: [&str; 7] = [
    "/max_model_len",
    "/loaded_context_length",
    "/context_length",
    "/context_window",
    "/top_provider/context_length",
    "/meta/n_ctx",
    "/max_context_length",
];

/// Reads `GET /models`.
pub fn of_models(value: &Value, model: &str) -> Facts {
    let list = value.get("data").or_else(|| value.get("models")).unwrap_or(value);
    let Some(models) = list.as_array().filter(|models| !models.is_empty()) else {
        return Facts::default();
    };
    let is = |entry: &&Value| {
        let names = ["id", "name", "model"];
        names.iter().any(|field| entry.get(*field).and_then(Value::as_str) == Some(model))
    };
    let listed = models.iter().find(is);
    // A server with one model serves it under any name.
    let entry = listed.or_else(|| models.first().filter(|_| models.len() == 1));
    let context = entry
        .and_then(|entry| CONTEXT_FIELDS.iter().find_map(|field| tokens(entry.pointer(field)?)));
    Facts { context, slots: None, is_model_listed: Some(listed.is_some()) }
}

/// Reads `GET /props` of llama.cpp.
pub fn of_props(value: &Value) -> Facts {
    let context = ["/default_generation_settings/n_ctx", "/n_ctx"];
    let slots = value.get("total_slots").and_then(Value::as_u64);
    Facts {
        context: context.iter().find_map(|field| tokens(value.pointer(field)?)),
        slots: slots.and_then(|slots| usize::try_from(slots).ok()).filter(|slots| *slots > 0),
        is_model_listed: None,
    }
}

/// Reads the context of a model from `GET /api/ps` of Ollama.
pub fn of_running(value: &Value, model: &str) -> Option<u64> {
    let models = value.get("models")?.as_array()?;
    let named = |entry: &&Value| {
        let name = entry.get("name").and_then(Value::as_str).unwrap_or_default();
        name == model || name.strip_suffix(":latest") == Some(model)
    };
    tokens(models.iter().find(named)?.get("context_length")?)
}

fn tokens(value: &Value) -> Option<u64> {
    value.as_u64().filter(|tokens| (256..=1_000_000_000).contains(tokens))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_list_of_models_tells_the_context() {
        for entry in [
            json!({"id": "m", "max_model_len": 4096}),
            json!({"id": "m", "context_length": 4096}),
            json!({"id": "m", "context_window": 4096}),
            json!({"id": "m", "max_context_length": 32768, "loaded_context_length": 4096}),
            json!({"id": "m", "meta": {"n_ctx": 4096, "n_ctx_train": 32768}}),
        ] {
            let facts = of_models(&json!({"data": [{"id": "other"}, entry]}), "m");
            assert_eq!((facts.context, facts.is_model_listed), (Some(4096), Some(true)), "{entry}");
        }
        let only =
            of_models(&json!({"data": [{"id": "/models/x.gguf", "max_model_len": 512}]}), "m");
        assert_eq!((only.context, only.is_model_listed), (Some(512), Some(false)));
        for odd in [
            json!(null),
            json!({}),
            json!({"data": []}),
            json!({"data": [7]}),
            json!([{"id": "m"}]),
        ] {
            assert_eq!(of_models(&odd, "m").context, None, "{odd}");
        }
    }

    #[test]
    fn llama_cpp_and_ollama_tell_more() {
        let props = json!({"default_generation_settings": {"n_ctx": 4096}, "total_slots": 1});
        let facts = of_props(&props);
        assert_eq!((facts.context, facts.slots), (Some(4096), Some(1)));
        let running = json!({"models": [{"name": "llava:latest", "context_length": 8192}]});
        assert_eq!(of_running(&running, "llava"), Some(8192));
        assert_eq!(of_running(&json!({}), "llava"), None);
    }
}
