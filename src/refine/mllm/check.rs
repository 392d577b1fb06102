//! Finds out with a few small requests what the servers of the models can do.

use std::sync::Arc;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use serde::Serialize;
use serde_json::Value;
use whereabouts_core::ModelServer;
use whereabouts_store::TokenBuckets;

use super::capability::Capabilities;
use super::check_calls::{picture_call, ranking_call};
use super::client::{Answer, Call, MllmClient};
use super::endpoint::sibling;
use super::failure::{Failure, FailureKind};
use super::judge::refuses;
use super::labels::Labels;
use super::schema::AnswerFormat;
use super::server_facts::{Facts, of_models, of_props, of_running};
use super::settings::{MaxTokensField, MllmSettings, MllmSettingsError};

/// How long a server may take to tell about itself.
const FACTS_TIMEOUT: Duration = Duration::from_secs(5);

/// The most of what it tells that is read, in bytes.
const FACTS_BYTES: usize = 4 << 20;

/// The pause before a check that met a passing failure is tried again.
const PAUSE: Duration = Duration::from_millis(500);

/// Calls that are made at once to find out whether the server works on them side by side.
const AT_ONCE: usize = 3;

/// The context that Ollama has unless it is told otherwise. It cuts longer prompts without saying so.
const OLLAMA_CONTEXT: u64 = 4096;

/// One thing that was found out about a server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was checked.
    pub what: &'static str,
    /// Whether the refiner can work with it.
    pub ok: bool,
    /// What was found, or what to do.
    pub detail: String,
}

/// A server that was checked.
#[derive(Debug, Clone, Serialize)]
pub struct CheckedServer {
    /// What it is used for.
    pub used_for: &'static str,
    /// The findings, in the order in which they were made.
    pub findings: Vec<Finding>,
    /// What the refiner makes of them.
    pub server: ModelServer,
}

/// Checks the servers of the settings.
pub async fn check(settings: &MllmSettings) -> Result<Vec<CheckedServer>, MllmSettingsError> {
    let new = |server| MllmClient::new(settings, &server, TokenBuckets::default()).map(Arc::new);
    let describer = new(settings.describing())?;
    let reasoner = match settings.has_two_servers() {
        true => new(settings.reasoning())?,
        false => Arc::clone(&describer),
    };
    Ok(check_clients(&describer, &reasoner, settings).await)
}

/// Checks a server again that refused so much that it is not known what it refuses.
pub(super) fn again(
    describer: &Arc<MllmClient>,
    reasoner: &Arc<MllmClient>,
    settings: &MllmSettings,
) {
    let wanted = [describer, reasoner].map(|client| client.take_wants_check());
    if wanted.contains(&true) {
        for client in [describer, reasoner] {
            let (temperature, field) = (settings.temperature >= 0.0, settings.max_tokens_field);
            client.revise(|known| known.assume_again(temperature, field));
        }
        in_background(describer, reasoner, settings);
    }
}

/// Checks the servers of a refiner, whose calls wait until that is done.
pub(super) fn in_background(
    describer: &Arc<MllmClient>,
    reasoner: &Arc<MllmClient>,
    settings: &MllmSettings,
) {
    let (describer, reasoner) = (Arc::clone(describer), Arc::clone(reasoner));
    let settings = settings.clone();
    describer.check_begins();
    reasoner.check_begins();
    tokio::spawn(async move {
        let checking = check_clients(&describer, &reasoner, &settings);
        let checked = tokio::time::timeout(settings.timeout(), checking).await;
        let checked = checked.unwrap_or_else(|_| {
            describer.stays_unchecked();
            reasoner.stays_unchecked();
            Vec::new()
        });
        describer.checked();
        reasoner.checked();
        for CheckedServer { used_for, findings, server } in checked {
            for Finding { what, detail, .. } in findings.iter().filter(|finding| !finding.ok) {
                tracing::warn!(
                    server = server.url,
                    used_for,
                    what,
                    detail,
                    "the MLLM cannot be used"
                );
            }
            tracing::info!(
                server = server.url,
                used_for,
                can = %serde_json::to_string(&server.capabilities).unwrap_or_default(),
                "the MLLM server was checked"
            );
        }
    });
}

async fn check_clients(
    describer: &MllmClient,
    reasoner: &MllmClient,
    settings: &MllmSettings,
) -> Vec<CheckedServer> {
    let describes = Some(settings.describe_model.as_str());
    let reasons = Some(settings.reason_model.as_str());
    let mut checked = Vec::new();
    match settings.has_two_servers() {
        false => {
            let check = Check::new(describer, describes, reasons);
            checked.push(check.run("describing and ranking").await);
        }
        true => {
            checked.push(Check::new(describer, describes, None).run("describing").await);
            checked.push(Check::new(reasoner, None, reasons).run("ranking").await);
        }
    }
    checked
}

/// The check of one server.
struct Check<'a> {
    client: &'a MllmClient,
    /// The model that is to describe pairs there.
    describes: Option<&'a str>,
    /// The model that is to rank there.
    reasons: Option<&'a str>,
    findings: Vec<Finding>,
    /// What the server was assumed to be able to do.
    assumed: Capabilities,
}

/// Adds a feature to those that a server is known to support, if it is not among them.
type Trial = Box<dyn Fn(Capabilities) -> Option<Capabilities> + Send>;

/// The check ended early, because the server does not answer.
struct Ended;

impl<'a> Check<'a> {
    fn new(client: &'a MllmClient, describes: Option<&'a str>, reasons: Option<&'a str>) -> Self {
        let assumed = client.capabilities();
        Self { client, describes, reasons, findings: Vec::new(), assumed }
    }

    async fn run(mut self, used_for: &'static str) -> CheckedServer {
        let facts = self.facts().await;
        self.learn(facts);
        // Whether it ended early is in the findings.
        let _ = self.calls().await;
        self.client.settled();
        self.client.revise(|known| known.checked_at = Some(Timestamp::now()));
        CheckedServer { used_for, findings: self.findings, server: self.client.report() }
    }

    fn model(&self) -> &'a str {
        self.describes.or(self.reasons).unwrap_or_default()
    }

    fn found(&mut self, what: &'static str, ok: bool, detail: impl Into<String>) {
        self.findings.push(Finding { what, ok, detail: detail.into() });
    }

    async fn calls(&mut self) -> Result<(), Ended> {
        if let Some(model) = self.describes {
            self.pictures(model).await?;
        }
        if let Some(model) = self.reasons {
            self.ranking(model).await?;
        }
        self.restore().await;
        self.side_by_side().await;
        self.ollama().await;
        Ok(())
    }

    /// Asks the server what it tells about itself, in the ways of several kinds of servers.
    async fn facts(&self) -> Facts {
        let models = self.get("models", false).await;
        let props = self.get("props", true).await;
        let of_models = models.map(|models| of_models(&models, self.model())).unwrap_or_default();
        of_models.or(props.map(|props| of_props(&props)).unwrap_or_default())
    }

    fn learn(&mut self, facts: Facts) {
        if let Some(context) = facts.context {
            self.found("context", true, format!("{context} tokens"));
        }
        if let Some(slots) = facts.slots {
            self.found("slots", true, format!("the server works on {slots} calls at once"));
        }
        if facts.is_model_listed == Some(false) {
            let model = self.model();
            self.found(
                "model",
                true,
                format!("the server does not list {model}; it may have it all the same"),
            );
        }
        self.client.revise(|known| {
            known.context = facts.context.or(known.context);
            known.slots = facts.slots.or(known.slots);
            known.checked_at = Some(Timestamp::now());
        });
    }

    async fn pictures(&mut self, model: &str) -> Result<(), Ended> {
        const WHAT: &str = "two pictures";
        let failure = match self.ask(picture_call(self.client, model, 2)).await {
            Ok(answer) => {
                self.client.proven();
                self.client.revise(|known| known.two_pictures = Some(true));
                let said: String = answer.text.chars().take(120).collect();
                match refuses(&said) {
                    false => self.found(WHAT, true, "accepted in one request"),
                    true => {
                        let detail = format!(
                            "the server accepted them, but the model refused to look: use a multimodal model that \
                             describes places (mllm.describe_model). It said: {said}"
                        );
                        self.found(WHAT, false, detail);
                    }
                }
                return Ok(());
            }
            Err(failure) if failure.kind != FailureKind::Request => {
                return self.ended("an answer", &failure).await;
            }
            Err(failure) => failure,
        };
        if self.accepts_plainly(&picture_call(self.client, model, 1)).await {
            self.client.proven();
            self.client.revise(|known| known.two_pictures = Some(false));
            let detail = format!(
                "the server takes one picture in a request, so both are sent side by side in one, which may be \
                 scaled down. If it can be started so that it takes two, do (vLLM: --limit-mm-per-prompt \
                 '{{\"image\": 2}}'). It said: {}",
                failure.why
            );
            self.found(WHAT, true, detail);
            return Ok(());
        }
        let none = self.accepts_plainly(&picture_call(self.client, model, 0)).await;
        let detail = match none {
            true => format!(
                "the model takes no pictures: use a multimodal one (mllm.describe_model). It said: {}",
                failure.why
            ),
            false => failure.why.clone(),
        };
        self.client.note(&Failure { why: detail.clone(), ..failure.clone() });
        self.found(WHAT, false, detail);
        self.client.suspend().await;
        Err(Ended)
    }

    /// Whether the server accepts a call without anything that it need not support.
    async fn accepts_plainly(&self, call: &Call<'_>) -> bool {
        let plainest = self.client.capabilities().plainest();
        let sent = self.client.sent(call, &plainest, false);
        self.client.send(call, &plainest, sent).await.is_ok()
    }

    /// Where much was left out at once, finds out which of it the server accepts by itself.
    async fn restore(&mut self) {
        let mut known = self.client.capabilities();
        let assumed = self.assumed;
        if assumed.left_out_by(&known) < 2 {
            return;
        }
        let labels = Labels::new(vec![0, 1], None);
        let call = match self.reasons {
            Some(model) => ranking_call(self.client, model, &labels),
            None => picture_call(self.client, self.model(), 0),
        };
        let fields = [MaxTokensField::MaxCompletionTokens, MaxTokensField::MaxTokens];
        let mut trials: Vec<Trial> = vec![
            Box::new(move |known| {
                let temperature = assumed.temperature && !known.temperature;
                temperature.then_some(Capabilities { temperature: true, ..known })
            }),
            Box::new(|known| (!known.system).then_some(Capabilities { system: true, ..known })),
        ];
        for field in fields {
            trials.push(Box::new(move |known| {
                let max_tokens_field = Some(field);
                known
                    .max_tokens_field
                    .is_none()
                    .then_some(Capabilities { max_tokens_field, ..known })
            }));
        }
        for format in AnswerFormat::ALL.into_iter().filter(|_| self.reasons.is_some()) {
            trials.push(Box::new(move |known| {
                (format < known.format).then_some(Capabilities { format, ..known })
            }));
        }
        for trial in trials {
            let Some(trial) = trial(known) else { continue };
            let sent = self.client.sent(&call, &trial, false);
            if self.client.send(&call, &trial, sent).await.is_ok() {
                known = trial;
            }
        }
        self.client.revise(|kept| *kept = known);
    }

    async fn ranking(&mut self, model: &str) -> Result<(), Ended> {
        let labels = Labels::new(vec![0, 1], None);
        let call = ranking_call(self.client, model, &labels);
        match self.ask(call).await {
            Err(failure) => self.ended("a ranking", &failure).await,
            Ok(answer) => {
                self.client.proven();
                let format = self.client.capabilities().format.as_str();
                let (ok, detail) = match labels.parse(&answer.text, false) {
                    Ok(_) => (true, format!("readable; asked for with the format {format}")),
                    Err(error) => (
                        false,
                        format!(
                            "the model answers, but {error}; jobs keep the coarse order where it does so"
                        ),
                    ),
                };
                self.found("a ranking", ok, detail);
                Ok(())
            }
        }
    }

    /// Finds out whether the server works on calls side by side, where it does not tell.
    async fn side_by_side(&mut self) {
        let calls = AT_ONCE.min(self.client.report().capabilities.calls_at_once);
        if calls < 2 || self.client.capabilities().slots.is_some() {
            return;
        }
        let model = self.reasons.or(self.describes).unwrap_or_default();
        let began = Instant::now();
        if self.client.exchange(&picture_call(self.client, model, 0)).await.is_err() {
            return;
        }
        let alone = began.elapsed();
        let began = Instant::now();
        let together =
            futures_util::future::join_all((0..calls).map(|_| async {
                self.client.exchange(&picture_call(self.client, model, 0)).await
            }));
        let outcomes = together.await;
        let took = began.elapsed();
        let answered = outcomes.iter().filter(|outcome| outcome.is_ok()).count();
        let turned_away = outcomes
            .iter()
            .filter_map(|outcome| outcome.as_ref().err())
            .any(|failure| failure.kind == FailureKind::Busy || failure.status == Some(503));
        let one_by_one =
            alone >= Duration::from_millis(200) && took >= alone.mul_f64(calls as f64 * 0.8);
        if turned_away || one_by_one {
            let at_once = if one_by_one { 1 } else { answered.max(1) };
            // The server may bear more when it is less busy, so this is where the limit starts.
            self.client.gate().adjust(|limit| limit.start_from(at_once));
            self.found("calls at once", true, format!("the server works on {at_once} at a time"));
        } else {
            self.found("calls at once", true, format!("{calls} were answered side by side"));
        }
    }

    /// Ollama tells the context of a model once it is loaded.
    async fn ollama(&mut self) {
        if self.client.capabilities().context.is_some() {
            return;
        }
        let version = self.get("api/version", true).await;
        if !version.is_some_and(|version| version.get("version").is_some_and(Value::is_string)) {
            return;
        }
        let running = self.get("api/ps", true).await;
        let told = running.and_then(|running| of_running(&running, self.model()));
        let context = told.unwrap_or(OLLAMA_CONTEXT);
        self.client.revise(|known| known.context = Some(context));
        let detail = match told {
            Some(context) => format!("{context} tokens"),
            None => format!("{context} tokens are assumed, which is Ollama's default"),
        };
        self.found("context", true, detail);
    }

    async fn ended(&mut self, what: &'static str, failure: &Failure) -> Result<(), Ended> {
        self.client.note(failure);
        match failure.kind.stops_all() {
            true => self.client.suspend().await,
            false => self.client.stays_unchecked(),
        }
        self.found(what, false, failure.why.clone());
        Err(Ended)
    }

    /// Makes a call, and once more after a passing failure.
    async fn ask(&self, call: Call<'_>) -> Result<Answer, Failure> {
        match self.client.exchange(&call).await {
            Err(failure) if failure.kind.is_transient() && failure.kind != FailureKind::Timeout => {
                tokio::time::sleep(failure.retry_after.unwrap_or(PAUSE).min(FACTS_TIMEOUT)).await;
                self.client.exchange(&call).await
            }
            outcome => outcome,
        }
    }

    async fn get(&self, path: &str, at_root: bool) -> Option<Value> {
        let url = sibling(&self.client.url, path, at_root);
        let request = self.client.http.get(url).headers(self.client.headers.clone());
        let response = request.timeout(FACTS_TIMEOUT).send().await.ok()?;
        if !response.status().is_success() {
            return None;
        }
        let (body, _) = self.client.read(response, FACTS_BYTES).await.ok()?;
        serde_json::from_slice(&body).ok()
    }
}
