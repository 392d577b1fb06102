//! Habits of servers and models, one a row of `habits.toml`: what is sent, and what becomes of the job.
//!
//! Each row has its own server, with a real socket. A job of four candidates, which are labelled in coarse order,
//! meets the habit; what the habit does not touch goes well, and the model's ranking is then `BADC`.

use std::sync::OnceLock;

use serde::Deserialize;
use serde_json::{Value, json};
use whereabouts_testkit::mock_mllm::{Purpose, RawCall, ranking};

use super::limits::Reverse;
use super::*;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    habit: Vec<Habit>,
}

/// A row.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Habit {
    /// What is peculiar about it.
    name: String,
    /// Where it was reported, if it was.
    #[serde(default)]
    report: String,
    /// Which calls meet it: `describe` (the first description), `pair` (all attempts at the second pair), `reason`
    /// (the first ranking), `reasons` (all rankings), `every` call, or only calls that contain what the server
    /// `refuses`.
    at: String,
    /// What a refused call contains.
    #[serde(default)]
    refuses: String,
    /// What the model says, in an ordinary response.
    content: Option<String>,
    /// Other fields of the message, as JSON.
    #[serde(default)]
    message: String,
    /// The reason why the model stopped.
    #[serde(default = "stop")]
    finish: String,
    /// The `usage` of the response, as JSON.
    #[serde(default)]
    usage: String,
    /// The whole body, in place of an ordinary response.
    body: Option<String>,
    #[serde(default = "success")]
    status: u16,
    #[serde(default)]
    headers: Vec<(String, String)>,
    /// The job's ranking: the labels in order.
    #[serde(default = "right")]
    order: String,
    /// Whether the job is degraded, and what it says of it.
    #[serde(default)]
    says: Vec<String>,
    /// How many calls describe and rank, refused ones included, if that matters.
    describes: Option<usize>,
    reasons: Option<usize>,
    /// The most calls of all.
    most: Option<usize>,
    /// How many calls have estimated tokens.
    #[serde(default)]
    estimated: u32,
    /// The pictures of the second pair, once it is known.
    #[serde(skip)]
    pair: OnceLock<Vec<String>>,
}

fn stop() -> String {
    "stop".into()
}

fn success() -> u16 {
    200
}

fn right() -> String {
    "BADC".into()
}

impl Habit {
    fn applies(&self, call: &RawCall<'_>) -> bool {
        let number = call.number;
        let at = match self.at.as_str() {
            "describe" => call.purpose == Purpose::Describe && number == 1,
            "pair" => call.purpose == Purpose::Describe && self.is_the_pair(call),
            "reason" => call.purpose == Purpose::Reason && number == 1,
            "reasons" => call.purpose == Purpose::Reason,
            "every" => call.purpose != Purpose::Check,
            at => panic!("{}: at {at}", self.name),
        };
        at && (self.refuses.is_empty() || contains(call.body, &self.refuses))
    }

    /// Whether a call describes the pair that the second call of all describes, which is the second at one call at a
    /// time.
    fn is_the_pair(&self, call: &RawCall<'_>) -> bool {
        let pictures = || {
            let parts = call.body["messages"].as_array().into_iter().flatten();
            let parts = parts.filter_map(|message| message["content"].as_array()).flatten();
            let pictures = parts.filter_map(|part| part["image_url"]["url"].as_str());
            pictures.map(str::to_owned).collect::<Vec<String>>()
        };
        if call.number == 2 {
            let _ = self.pair.set(pictures());
        }
        self.pair.get() == Some(&pictures())
    }

    fn reply(&self) -> Reply {
        let body = self.body.clone().unwrap_or_else(|| {
            let mut message = json!({"role": "assistant", "content": self.content});
            if !self.message.is_empty() {
                let fields: Value = serde_json::from_str(&self.message).unwrap();
                for (name, value) in fields.as_object().unwrap() {
                    message[name] = value.clone();
                }
            }
            let usage: Value = match self.usage.as_str() {
                "" => json!({"prompt_tokens": 100, "completion_tokens": 10, "total_tokens": 110}),
                usage => serde_json::from_str(usage).unwrap(),
            };
            let choice = json!({"index": 0, "message": message, "finish_reason": self.finish});
            json!({"id": "x", "object": "chat.completion", "choices": [choice], "usage": usage})
                .to_string()
        });
        Reply::Raw { status: self.status, headers: self.headers.clone(), body }
    }
}

/// Whether a request contains what a server refuses.
fn contains(body: &Value, feature: &str) -> bool {
    let has = |field: &str| body.get(field).is_some();
    let text = body["messages"].to_string();
    match feature.split_once(' ').unwrap_or((feature, "")) {
        ("format", "") => has("response_format"),
        ("format", kind) => body["response_format"]["type"] == kind,
        ("bounds", _) => body["response_format"].to_string().contains("minItems"),
        ("system", _) => body["messages"][0]["role"] == "system",
        ("more", tokens) => {
            let bound = body.get("max_tokens").or(body.get("max_completion_tokens"));
            bound.is_some_and(|bound| bound.as_u64() > tokens.parse().ok())
        }
        ("longer", chars) => body["messages"].to_string().len() > chars.parse().unwrap(),
        ("pictures", _) => text.contains("image_url"),
        (field, _) => has(field),
    }
}

/// Returns what is wrong with the job, if anything is.
async fn meets(habit: &'static Habit) -> Result<(), String> {
    let script = Script {
        intercept: Box::new(|call| habit.applies(call).then(|| habit.reply())),
        // Long enough that not all of them fit into a short context.
        describe: Box::new(|call| {
            let walls: Vec<String> = (1..=350).map(|wall| format!("wall {wall}")).collect();
            Reply::Text(format!("notes {}. {}", call.number, walls.join(", ")))
        }),
        reason: Box::new(|_| ranking(&["B", "A", "D", "C"])),
        ..Script::default()
    };
    let mut bench = Bench::with(script, |settings| {
        settings.concurrency = 1;
        settings.hide_coarse_rank = false;
        settings.breaker_open_s = 3600;
        settings.answer_max_bytes = 100_000;
    })
    .await;
    bench.fallback = Some(Arc::new(Reverse));
    bench.rebuild(|_| {});
    let refinement = bench.refine(4).await.map_err(|error| format!("no ranking: {error}"))?;
    let order: String =
        ranks(&refinement).iter().map(|rank| char::from(b'@' + *rank as u8)).collect();
    let degraded = refinement.degraded.unwrap_or_default();
    if order != habit.order {
        return Err(format!("the order is {order}: {degraded}"));
    }
    if degraded.is_empty() != habit.says.is_empty()
        || habit.says.iter().any(|words| !degraded.contains(words))
    {
        return Err(format!("the job says {degraded:?}"));
    }
    let (describes, reasons) =
        (bench.mock.arrived(Purpose::Describe), bench.mock.arrived(Purpose::Reason));
    let differs = |wanted: Option<usize>, count| wanted.is_some_and(|wanted| wanted != count);
    if differs(habit.describes, describes)
        || differs(habit.reasons, reasons)
        || habit.most.is_some_and(|most| describes + reasons > most)
    {
        return Err(format!("{describes} calls describe and {reasons} rank"));
    }
    let usage = refinement.usage;
    if usage.estimated != habit.estimated {
        return Err(format!("{} calls are estimated", usage.estimated));
    }
    let tokens = usage.prompt_tokens + usage.completion_tokens;
    if tokens > 1_000_000 || (usage.calls > 0 && tokens < u64::from(usage.calls)) {
        return Err(format!("{usage:?}"));
    }
    match bench.mock.violations().first() {
        Some(violation) => Err(format!("the request was wrong: {violation}")),
        None => Ok(()),
    }
}

#[tokio::test]
async fn every_habit_of_the_table_is_met() {
    let table: Table = toml::from_str(include_str!("habits.toml")).unwrap();
    let table: &'static Table = Box::leak(Box::new(table));
    assert!(table.habit.len() >= 120, "{} habits", table.habit.len());
    let reported = table.habit.iter().filter(|habit| !habit.report.is_empty()).count();
    assert!(reported >= 30, "{reported} habits have a report");
    let mut unmet = Vec::new();
    for habit in &table.habit {
        if let Err(why) = meets(habit).await {
            unmet.push(format!("{}: {why}", habit.name));
        }
    }
    assert!(unmet.is_empty(), "{} of {}:\n{}", unmet.len(), table.habit.len(), unmet.join("\n"));
}
