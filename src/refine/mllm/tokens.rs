//! Token counts: those that servers report, as far as they can be believed, and estimates.

use serde_json::Value;

/// More tokens than any model reads or writes in one call.
const MOST_READ: u64 = 5_000_000;
const MOST_WRITTEN: u64 = 1_000_000;

/// The counts of a response that can be believed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counted {
    /// Tokens sent.
    pub prompt: Option<u64>,
    /// Tokens received.
    pub completion: Option<u64>,
}

impl Counted {
    /// Reads the field `usage` of a response.
    pub fn of(usage: Option<&Value>) -> Self {
        let Some(usage) = usage else { return Self::default() };
        let first =
            |fields: &[&str], most| fields.iter().find_map(|field| count(usage.get(*field)?, most));
        let prompt = first(&["prompt_tokens", "input_tokens", "promptTokenCount"], MOST_READ);
        let completion =
            first(&["completion_tokens", "output_tokens", "candidatesTokenCount"], MOST_WRITTEN);
        // Some servers count thinking only here.
        let thought = usage.pointer("/completion_tokens_details/reasoning_tokens");
        let thought = thought.and_then(|value| count(value, MOST_WRITTEN));
        let total = first(&["total_tokens"], MOST_READ + MOST_WRITTEN);
        let rest = || total.zip(prompt).and_then(|(total, prompt)| total.checked_sub(prompt));
        Self { prompt, completion: completion.or(thought).or_else(|| rest().filter(|n| *n > 0)) }
    }
}

/// Reads a positive whole number.
fn count(value: &Value, most: u64) -> Option<u64> {
    let number = match value {
        Value::Number(number) => number.as_f64()?,
        Value::String(text) => text.trim().parse().ok()?,
        _ => return None,
    };
    let believable = number.fract() == 0.0 && number >= 1.0 && number <= most as f64;
    believable.then_some(number as u64)
}

/// Estimates the tokens of a text: four letters of English make about one, and a letter of other scripts is one.
pub fn estimate(text: &str) -> u64 {
    let (mut narrow, mut wide) = (0_u64, 0_u64);
    for c in text.chars() {
        if (c as u32) < 0x2e80 { narrow += c.len_utf8() as u64 } else { wide += 1 }
    }
    narrow.div_ceil(4) + wide
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn counted(usage: Value) -> (Option<u64>, Option<u64>) {
        let Counted { prompt, completion } = Counted::of(Some(&usage));
        (prompt, completion)
    }

    #[test]
    fn only_counts_that_can_be_true_are_believed() {
        let both = (Some(120), Some(7));
        assert_eq!(counted(json!({"prompt_tokens": 120, "completion_tokens": 7})), both);
        assert_eq!(counted(json!({"prompt_tokens": 120.0, "completion_tokens": "7"})), both);
        assert_eq!(counted(json!({"input_tokens": 120, "output_tokens": 7})), both);
        assert_eq!(counted(json!({"prompt_tokens": 120, "total_tokens": 127})), both);
        let thought = json!({"prompt_tokens": 120, "completion_tokens": 0,
            "completion_tokens_details": {"reasoning_tokens": 7}});
        assert_eq!(counted(thought), both);
        for wrong in [
            json!(0),
            json!(null),
            json!(-5),
            json!(12.5),
            json!(1e30),
            json!(u64::MAX),
            json!("many"),
        ] {
            let usage = json!({"prompt_tokens": wrong, "completion_tokens": wrong});
            assert_eq!(counted(usage), (None, None), "{wrong}");
        }
        assert_eq!(counted(Value::Null), (None, None));
        assert_eq!(Counted::of(None), Counted::default());
    }

    #[test]
    fn tokens_are_estimated_by_script() {
        assert_eq!((estimate(""), estimate("abcdefgh"), estimate("銀行")), (0, 2, 2));
    }
}
