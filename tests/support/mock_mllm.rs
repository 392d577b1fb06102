//! A mock of an MLLM server: a real HTTP server on a free port that speaks the chat-completions
//! format, rejects what the real API would reject, and answers from a script, with faults on demand.

mod checks;

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{HeaderMap, Method, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::sync::Barrier;
use tokio::task::JoinHandle;

use checks::{ParsedCall, check_envelope, check_order, check_request, notes_in, purpose_of};

/// The hashes of the two pictures of a describe call, as they were sent.
pub type Pair = (String, String);

/// A describe call, as the script sees it.
pub struct DescribeCall {
    /// 1 for the first describe call.
    pub number: usize,
    pub pair: Pair,
    pub prompt: String,
}

/// A reason call, as the script sees it.
pub struct ReasonCall {
    /// 1 for the first reason call.
    pub number: usize,
    /// Label and text, in the order of the prompt.
    pub notes: Vec<(String, String)>,
    pub prompt: String,
    /// Whether the call repeats one whose answer was rejected.
    pub repair: bool,
    /// Whether the answer must follow a schema.
    pub structured: bool,
}

impl ReasonCall {
    pub fn labels(&self) -> Vec<&str> {
        self.notes.iter().map(|(label, _)| label.as_str()).collect()
    }

    /// The labels, with those whose notes contain `text` first.
    pub fn labels_with_first(&self, text: &str) -> Vec<&str> {
        let (mut first, rest): (Vec<_>, Vec<_>) =
            self.notes.iter().partition(|(_, notes)| notes.contains(text));
        first.extend(rest);
        first.iter().map(|(label, _)| label.as_str()).collect()
    }
}

/// What the mock does with a call.
#[derive(Clone)]
pub enum Reply {
    /// Answers with this text; a describe call with [`notes`] of it.
    Text(String),
    /// Answers with exactly this text.
    Said(String),
    /// Answers with this status, headers and body.
    Raw { status: u16, headers: Vec<(String, String)>, body: String },
    /// Answers 429 with this `Retry-After`.
    Busy(String),
    /// Answers with this status and message.
    Status(u16, String),
    /// Never answers.
    Hang,
    /// Breaks the connection before the body.
    Cut,
    /// Breaks the connection in the middle of the body.
    HalfBody,
    /// Answers 200 with a page that is not JSON.
    NotJson,
    /// Answers 200 with a body of more than this many bytes.
    Huge(usize),
}

/// A well-formed reasoning answer.
pub fn ranking(labels: &[&str]) -> Reply {
    Reply::Text(json!({"reasoning": "because", "ranking": labels}).to_string())
}

/// A description in the parts that prompts ask for.
pub fn notes(text: &str) -> String {
    format!("OBJECTS. {text}\nMATCHES. As listed.\nCOMPARISON. As listed.")
}

/// What a call is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    Describe,
    Reason,
    /// It finds out what the server can do.
    Check,
}

/// A call as it came, before it is checked.
pub struct RawCall<'a> {
    pub purpose: Purpose,
    /// 1 for the first call of its purpose.
    pub number: usize,
    pub body: &'a Value,
}

/// A describe or reason call that has arrived, and the load that it meets.
pub struct Load {
    pub purpose: Purpose,
    /// 1 for the first call that describes or ranks.
    pub number: usize,
    /// Calls in progress, this one included.
    pub in_flight: usize,
    /// Since the start of the mock.
    pub at: Duration,
}

type TurnAway = Box<dyn Fn(&Load) -> Option<Reply> + Send + Sync>;
type Delay = Box<dyn Fn(&Load) -> Duration + Send + Sync>;
type Facts = Box<dyn Fn(&str) -> Option<Value> + Send + Sync>;
type Intercept = Box<dyn Fn(&RawCall<'_>) -> Option<Reply> + Send + Sync>;
type Describe = Box<dyn Fn(&DescribeCall) -> Reply + Send + Sync>;
type Reason = Box<dyn Fn(&ReasonCall) -> Reply + Send + Sync>;

/// How the mock behaves.
pub struct Script {
    /// Answers a call instead of the rest of the script, which does not see it.
    pub intercept: Intercept,
    /// What `GET` of a path below the server's root returns.
    pub facts: Facts,
    pub describe: Describe,
    pub reason: Reason,
    /// Whether `response_format` is accepted; otherwise it is answered 400.
    pub structured: bool,
    /// Whether answers report their usage.
    pub counts_tokens: bool,
    /// The key that every call must carry.
    pub key: Option<String>,
    /// The longest edge that a picture may have, in pixels.
    pub max_edge: u32,
    /// How long each call takes.
    pub latency: Duration,
    /// Answers a call at once, because of the load.
    pub turn_away: TurnAway,
    /// How much longer a call takes because of the load.
    pub delay: Delay,
    /// Describe calls are held until this many are in flight.
    pub together: Option<usize>,
}

impl Default for Script {
    /// Names the pair in each description, and ranks in the order of the prompt.
    fn default() -> Self {
        Self {
            intercept: Box::new(|_| None),
            facts: Box::new(|_| None),
            describe: Box::new(|call| {
                Reply::Text(format!("notes on {} {}", call.pair.0, call.pair.1))
            }),
            reason: Box::new(|call| ranking(&call.labels())),
            structured: true,
            counts_tokens: true,
            key: None,
            max_edge: 768,
            latency: Duration::ZERO,
            turn_away: Box::new(|_| None),
            delay: Box::new(|_| Duration::ZERO),
            together: None,
        }
    }
}

/// What the mock has seen.
#[derive(Default)]
struct Seen {
    describe_calls: usize,
    reason_calls: usize,
    checks: usize,
    /// Describe, reason and check calls, whatever became of them.
    arrived: [usize; 3],
    in_flight: usize,
    max_in_flight: usize,
    turned_away: usize,
    /// How often each pair was requested, and how often answered.
    pairs: HashMap<Pair, (usize, usize)>,
    asked_again: usize,
    structure_refused: usize,
    violations: Vec<String>,
    reason_prompts: Vec<String>,
    /// Bytes of describe requests and of reason requests.
    request_bytes: (usize, usize),
}

struct Shared {
    script: Script,
    together: Option<Barrier>,
    began: Instant,
    seen: Mutex<Seen>,
}

/// The running mock; it ends when dropped.
pub struct MockMllm {
    url: String,
    shared: Arc<Shared>,
    server: JoinHandle<()>,
}

impl Drop for MockMllm {
    fn drop(&mut self) {
        self.server.abort();
    }
}

impl MockMllm {
    pub async fn start(script: Script) -> Self {
        let together = script.together.map(Barrier::new);
        let shared =
            Arc::new(Shared { script, together, began: Instant::now(), seen: Mutex::default() });
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/v1", listener.local_addr().unwrap());
        let router = Router::new().fallback(answer).with_state(Arc::clone(&shared));
        let server = tokio::spawn(async move { axum::serve(listener, router).await.unwrap() });
        Self { url, shared, server }
    }

    /// The base URL.
    pub fn url(&self) -> String {
        self.url.clone()
    }

    pub fn describe_calls(&self) -> usize {
        self.seen(|seen| seen.describe_calls)
    }

    pub fn reason_calls(&self) -> usize {
        self.seen(|seen| seen.reason_calls)
    }

    /// Calls that found out what the server can do.
    pub fn checks(&self) -> usize {
        self.seen(|seen| seen.checks)
    }

    /// Calls of a purpose that arrived, whatever became of them.
    pub fn arrived(&self, purpose: Purpose) -> usize {
        self.seen(|seen| seen.arrived[purpose as usize])
    }

    pub fn in_flight(&self) -> usize {
        self.seen(|seen| seen.in_flight)
    }

    pub fn max_in_flight(&self) -> usize {
        self.seen(|seen| seen.max_in_flight)
    }

    /// Calls that were turned away because of the load.
    pub fn turned_away(&self) -> usize {
        self.seen(|seen| seen.turned_away)
    }

    /// How often each pair was requested, and how often answered.
    pub fn pairs(&self) -> HashMap<Pair, (usize, usize)> {
        self.seen(|seen| seen.pairs.clone())
    }

    /// Describe calls for pairs that had been answered before.
    pub fn asked_again(&self) -> usize {
        self.seen(|seen| seen.asked_again)
    }

    /// Calls that were rejected because of their `response_format`.
    pub fn structure_refused(&self) -> usize {
        self.seen(|seen| seen.structure_refused)
    }

    /// Requests that the real API would have rejected.
    pub fn violations(&self) -> Vec<String> {
        self.seen(|seen| seen.violations.clone())
    }

    /// The prompts of the reason calls so far.
    pub fn reason_prompts(&self) -> Vec<String> {
        self.seen(|seen| seen.reason_prompts.clone())
    }

    /// Bytes of the describe requests and of the reason requests so far.
    pub fn request_bytes(&self) -> (usize, usize) {
        self.seen(|seen| seen.request_bytes)
    }

    fn seen<T>(&self, look: impl FnOnce(&Seen) -> T) -> T {
        look(&self.shared.seen.lock().unwrap())
    }
}

/// Counts a call as long as it lasts, even if the caller disconnects.
struct InFlight<'a>(&'a Mutex<Seen>);

impl<'a> InFlight<'a> {
    fn new(seen: &'a Mutex<Seen>) -> Self {
        let mut counts = seen.lock().unwrap();
        counts.in_flight += 1;
        counts.max_in_flight = counts.max_in_flight.max(counts.in_flight);
        Self(seen)
    }

    fn load(&self, purpose: Purpose, began: Instant) -> Load {
        let seen = self.0.lock().unwrap();
        let [describe, reason, _] = seen.arrived;
        Load { purpose, number: describe + reason, in_flight: seen.in_flight, at: began.elapsed() }
    }
}

impl Drop for InFlight<'_> {
    fn drop(&mut self) {
        self.0.lock().unwrap().in_flight -= 1;
    }
}

async fn answer(
    State(shared): State<Arc<Shared>>,
    method: Method,
    uri: Uri,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    let script = &shared.script;
    if method == Method::GET {
        return match (script.facts)(uri.path()) {
            Some(facts) => axum::Json(facts).into_response(),
            None => StatusCode::NOT_FOUND.into_response(),
        };
    }
    let mut purpose = Purpose::Describe;
    if let Ok(request) = serde_json::from_slice::<Value>(&body) {
        purpose = purpose_of(&request);
        let number = {
            let mut seen = shared.seen.lock().unwrap();
            seen.arrived[purpose as usize] += 1;
            seen.arrived[purpose as usize]
        };
        let call = RawCall { purpose, number, body: &request };
        if let Some(reply) = (script.intercept)(&call) {
            return render(reply, Some(100)).await;
        }
        if purpose == Purpose::Check {
            return shared.checked(&request);
        }
    }
    let in_flight = InFlight::new(&shared.seen);
    let load = in_flight.load(purpose, shared.began);
    if let Some(reply) = (script.turn_away)(&load) {
        shared.seen.lock().unwrap().turned_away += 1;
        return render(reply, Some(100)).await;
    }
    let parsed = check_envelope(&uri, &headers, script)
        .and_then(|()| serde_json::from_slice(&body).map_err(|error| error.to_string()))
        .and_then(|request: Value| check_request(&request, script.max_edge))
        .and_then(|parsed| check_order(&body).map(|()| parsed));
    let parsed = match parsed {
        Ok(parsed) => parsed,
        Err(violation) => {
            shared.seen.lock().unwrap().violations.push(violation.clone());
            return refusal(400, &violation);
        }
    };
    if parsed.structured && !script.structured {
        shared.seen.lock().unwrap().structure_refused += 1;
        return refusal(400, "Unsupported parameter: 'response_format'");
    }
    if let (Some(barrier), 2) = (&shared.together, parsed.pictures.len()) {
        barrier.wait().await;
    }
    let latency = script.latency + (script.delay)(&load);
    if !latency.is_zero() {
        // A slow model is part of the script.
        tokio::time::sleep(latency).await;
    }
    {
        let mut seen = shared.seen.lock().unwrap();
        let (describe, reason) = &mut seen.request_bytes;
        *if parsed.pictures.is_empty() { reason } else { describe } += body.len();
    }
    let prompt_tokens = body.len() / 100;
    let reply = shared.reply(parsed);
    render(reply, script.counts_tokens.then_some(prompt_tokens)).await
}

impl Shared {
    /// Answers a call that finds out what the server can do. It is no part of the script.
    fn checked(&self, request: &Value) -> Response {
        self.seen.lock().unwrap().checks += 1;
        if !self.script.structured && request.get("response_format").is_some() {
            return refusal(400, "Unsupported parameter: 'response_format'");
        }
        let ranks = request.to_string().contains("Rank both");
        let answer = json!({"reasoning": "a check", "ranking": ["A", "B"]}).to_string();
        let text = if ranks { answer.as_str() } else { "2" };
        axum::Json(completion(text, Some(10))).into_response()
    }

    fn reply(&self, parsed: ParsedCall) -> Reply {
        let mut seen = self.seen.lock().unwrap();
        let ParsedCall { pictures, prompt, repair, structured } = parsed;
        let [frame, candidate] = pictures.as_slice() else {
            seen.reason_calls += 1;
            seen.reason_prompts.push(prompt.clone());
            let number = seen.reason_calls;
            let notes = notes_in(&prompt);
            return (self.script.reason)(&ReasonCall { number, notes, prompt, repair, structured });
        };
        seen.describe_calls += 1;
        let pair = (frame.clone(), candidate.clone());
        let call = DescribeCall { number: seen.describe_calls, pair: pair.clone(), prompt };
        let (requested, answered) = seen.pairs.entry(pair.clone()).or_default();
        *requested += 1;
        let again = usize::from(*answered > 0);
        seen.asked_again += again;
        let reply = match (self.script.describe)(&call) {
            Reply::Text(text) if !text.trim().is_empty() => Reply::Said(notes(&text)),
            reply => reply,
        };
        if matches!(reply, Reply::Text(_) | Reply::Said(_)) {
            seen.pairs.entry(pair).or_default().1 += 1;
        }
        reply
    }
}

async fn render(reply: Reply, prompt_tokens: Option<usize>) -> Response {
    let json = |body: Body| ([(header::CONTENT_TYPE, "application/json")], body).into_response();
    let broken = |start: &'static str| {
        let cut = Err(std::io::Error::other("cut on purpose"));
        json(Body::from_stream(stream::iter([Ok(Bytes::from_static(start.as_bytes())), cut])))
    };
    match reply {
        Reply::Raw { status, headers, body } => {
            let mut response = Response::builder().status(status);
            for (name, value) in headers {
                response = response.header(name, value);
            }
            response.body(Body::from(body)).unwrap()
        }
        Reply::Text(text) | Reply::Said(text) => {
            json(Body::from(completion(&text, prompt_tokens).to_string()))
        }
        Reply::Busy(wait) => {
            let refused = refusal(429, "Rate limit reached");
            ([(header::RETRY_AFTER, wait)], refused).into_response()
        }
        Reply::Status(status, message) => refusal(status, &message),
        Reply::Hang => std::future::pending().await,
        Reply::Cut => broken(""),
        Reply::HalfBody => broken(r#"{"id": "chatcmpl-1", "choices": [{"mess"#),
        Reply::NotJson => "<html>502 Bad Gateway</html>".into_response(),
        Reply::Huge(bytes) => {
            let words = "wall ".repeat(bytes / 5 + 1);
            json(Body::from(completion(&words, prompt_tokens).to_string()))
        }
    }
}

fn completion(text: &str, prompt_tokens: Option<usize>) -> Value {
    let mut completion = json!({
        "id": "chatcmpl-1",
        "object": "chat.completion",
        "created": 1,
        "model": "mock",
        "choices": [{
            "index": 0,
            "message": {"role": "assistant", "content": text, "refusal": null},
            "finish_reason": "stop",
        }],
    });
    if let Some(prompt) = prompt_tokens {
        let answer = text.len() / 4;
        completion["usage"] = json!({
            "prompt_tokens": prompt,
            "completion_tokens": answer,
            "total_tokens": prompt + answer,
        });
    }
    completion
}

fn refusal(status: u16, message: &str) -> Response {
    let body = json!({"error": {
        "message": message, "type": "invalid_request_error", "param": null, "code": null,
    }});
    let json = [(header::CONTENT_TYPE, "application/json")];
    (StatusCode::from_u16(status).unwrap(), json, body.to_string()).into_response()
}
