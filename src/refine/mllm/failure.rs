//! Why an attempt at a call got no answer: the kind decides what follows, the server's own words are for people.

use std::time::Duration;

/// Why one attempt got no answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    /// What follows from it.
    pub kind: FailureKind,
    /// The HTTP status, if there was a response.
    pub status: Option<u16>,
    /// The cause, in the server's words where it has any.
    pub why: String,
    /// When the server wants to be asked again.
    pub retry_after: Option<Duration>,
    /// Whether the server did not take the call, for which too many calls at once may be the reason.
    pub turned_away: bool,
}

/// The kinds of failures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FailureKind {
    /// Nothing listens there.
    Refused,
    /// The host name has no address.
    Name,
    /// There is no trusted connection.
    Tls,
    /// No answer came in time.
    Timeout,
    /// The connection broke.
    Connection,
    /// The response is not a chat completion.
    NotChat,
    /// The server failed.
    Server,
    /// The server is overloaded or limits the rate of calls.
    Busy,
    /// The key is missing or not accepted.
    Key,
    /// The account has no quota or credit left.
    Quota,
    /// There is no such model, or no such path.
    NotFound,
    /// The server rejects the request.
    Request,
    /// The request is too large for the server.
    TooLarge,
    /// The server is somewhere else.
    Redirect,
    /// The server's content filter rejects this one request.
    Filtered,
    /// The answer is larger than the bound.
    LongAnswer,
}

impl FailureKind {
    /// Returns its name in logs and in the API.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Refused => "connection_refused",
            Self::Name => "name",
            Self::Tls => "tls",
            Self::Timeout => "timeout",
            Self::Connection => "connection",
            Self::NotChat => "not_a_chat_completion",
            Self::Server => "server_error",
            Self::Busy => "busy",
            Self::Key => "key",
            Self::Quota => "quota",
            Self::NotFound => "not_found",
            Self::Request => "request",
            Self::TooLarge => "too_large",
            Self::Redirect => "redirect",
            Self::Filtered => "content_filter",
            Self::LongAnswer => "long_answer",
        }
    }

    /// Whether all calls will fail in this way until its settings or account change. The circuit breaker opens at
    /// once.
    pub fn stops_all(self) -> bool {
        use FailureKind::{Key, NotFound, Quota, Redirect, Request, TooLarge};
        matches!(self, Key | Quota | NotFound | Request | TooLarge | Redirect)
    }

    /// Whether the server or the connection failed. The circuit breaker counts these.
    pub fn is_the_servers(self) -> bool {
        use FailureKind::{Connection, Name, NotChat, Refused, Server, Timeout, Tls};
        matches!(self, Connection | Name | NotChat | Refused | Server | Timeout | Tls)
    }

    /// Whether the same call may succeed later.
    pub fn is_transient(self) -> bool {
        self.is_the_servers() || self == Self::Busy
    }
}

impl Failure {
    /// Creates a failure without a response.
    pub fn new(kind: FailureKind, why: String) -> Self {
        Self { kind, status: None, why, retry_after: None, turned_away: kind == FailureKind::Busy }
    }

    /// Classifies a response. `body` is searched for codes; `message` is what people read.
    pub fn of_response(
        status: Option<u16>,
        body: &str,
        message: &str,
        retry_after: Option<Duration>,
    ) -> Self {
        let kind = kind_of(status, &format!("{body} {message}").to_lowercase());
        let answered = match status {
            Some(status) => format!("the MLLM server answered {status}"),
            None => "the MLLM server answered with an error".to_owned(),
        };
        let hint = match kind {
            FailureKind::Key => " (check mllm.api_key)",
            FailureKind::Quota => " (the account has no quota left)",
            FailureKind::NotFound => " (check mllm.base_url and the names of the models)",
            FailureKind::Redirect => " (set mllm.base_url to where the server is)",
            FailureKind::TooLarge => " (lower mllm.image_max_edge, or raise the server's limit)",
            _ => "",
        };
        let words = format!("{body} {message}").to_lowercase();
        let turned_away = kind == FailureKind::Busy
            || (kind == FailureKind::Server && is_overloaded(status, &words));
        let message = if message.is_empty() { "no explanation" } else { message };
        Self { kind, status, why: format!("{answered}: {message}{hint}"), retry_after, turned_away }
    }
}

/// Whether a server that failed says that it has too much to do.
fn is_overloaded(status: Option<u16>, words: &str) -> bool {
    matches!(status, Some(503 | 529)) || OVERLOADED.iter().any(|wanted| words.contains(wanted))
}

fn kind_of(status: Option<u16>, words: &str) -> FailureKind {
    let says = |wanted: &[&str]| wanted.iter().any(|wanted| words.contains(wanted));
    match status {
        Some(300..400) => return FailureKind::Redirect,
        Some(402) => return FailureKind::Quota,
        Some(413) => return FailureKind::TooLarge,
        _ => {}
    }
    if says(&QUOTA) || (says(&[CURRENT_QUOTA]) && !says(&["retrydelay", "resource_exhausted"])) {
        return FailureKind::Quota;
    }
    if status != Some(429) && says(&FILTER) {
        return FailureKind::Filtered;
    }
    let about_model = says(&["model"]) && says(&NO_MODEL);
    match status {
        Some(429) => FailureKind::Busy,
        Some(401 | 403 | 407) => FailureKind::Key,
        _ if says(&KEY) => FailureKind::Key,
        Some(404 | 410) => FailureKind::NotFound,
        Some(408) => FailureKind::Timeout,
        Some(409 | 423 | 425) => FailureKind::Server,
        Some(400..500) | None if about_model => FailureKind::NotFound,
        Some(400..500) => FailureKind::Request,
        None if says(&BUSY) => FailureKind::Busy,
        _ => FailureKind::Server,
    }
}

const QUOTA: [&str; 10] = [
    "insufficient_quota",
    "billing_hard_limit",
    "billing_not_active",
    "credit balance",
    "insufficient balance",
    "insufficient credit",
    "insufficient_credit",
    "out of credits",
    "requires more credits",
    "arrearage",
];

/// Gemini says so of its rate limits, too, but then tells when to come back.
const CURRENT_QUOTA: &str = "exceeded your current quota";

const FILTER: [&str; 8] = [
    "content_filter",
    "content_policy",
    "content management policy",
    "responsibleaipolicy",
    "data_inspection_failed",
    "inappropriate content",
    "input was flagged",
    "prohibited_content",
];

const KEY: [&str; 9] = [
    "invalid api key",
    "incorrect api key",
    "invalid_api_key",
    "api key not valid",
    "invalid x-api-key",
    "authentication_error",
    "authenticationerror",
    "no auth credentials",
    "unauthorized",
];

const NO_MODEL: [&str; 8] = [
    "not found",
    "does not exist",
    "not exist",
    "unknown model",
    "invalid model",
    "no such model",
    "model_not_found",
    "is not available",
];

const OVERLOADED: [&str; 6] = [
    "overloaded",
    "server busy",
    "pending requests exceeded",
    "no slots available",
    "no slot available",
    "queue is full",
];

const BUSY: [&str; 4] = ["rate limit", "rate_limit", "too many requests", "overloaded"];

#[cfg(test)]
mod tests {
    use super::*;

    fn kind(status: u16, message: &str) -> FailureKind {
        Failure::of_response(Some(status).filter(|s| *s > 0), message, message, None).kind
    }

    #[test]
    fn a_server_that_has_too_much_to_do_turns_calls_away() {
        let turned_away = |status, message: &str| {
            Failure::of_response(Some(status), message, message, None).turned_away
        };
        for (status, message) in [
            (429, ""),
            (503, "Service Unavailable"),
            (529, "Overloaded"),
            (500, "server busy, please try again. maximum pending requests exceeded"),
            (500, "unexpected server status: llm busy - no slots available"),
            (500, "The engine is currently overloaded, please try again later"),
        ] {
            assert!(turned_away(status, message), "{status} {message}");
        }
        for (status, message) in
            [(500, "CUDA out of memory"), (502, "Bad Gateway"), (401, ""), (400, "overloaded word")]
        {
            assert!(!turned_away(status, message), "{status} {message}");
        }
    }

    #[test]
    fn a_response_is_classified_by_its_status_and_its_words() {
        use FailureKind::*;
        for (status, message, wanted) in [
            (401, "Incorrect API key provided", Key),
            (403, "Forbidden", Key),
            (400, "API key not valid. Please pass a valid API key.", Key),
            (500, "litellm.AuthenticationError: invalid api key", Key),
            (402, "Insufficient credits", Quota),
            (429, "{\"code\": \"insufficient_quota\"}", Quota),
            (429, "You exceeded your current quota, please check your plan", Quota),
            (429, "You exceeded your current quota. RESOURCE_EXHAUSTED retryDelay 38s", Busy),
            (400, "Your credit balance is too low to access the API", Quota),
            (429, "Rate limit reached", Busy),
            (404, "model not found", NotFound),
            (400, "The model `x` does not exist", NotFound),
            (400, "At most 1 image(s) may be provided in one request.", Request),
            (422, "Input validation error", Request),
            (400, "filtered due to the content management policy", Filtered),
            (413, "Request Entity Too Large", TooLarge),
            (307, "", Redirect),
            (408, "", Timeout),
            (409, "", Server),
            (500, "CUDA out of memory", Server),
            (529, "Overloaded", Server),
            (0, "Rate limit exceeded", Busy),
            (0, "upstream error", Server),
            (0, "model 'llava' not found, try pulling it first", NotFound),
        ] {
            assert_eq!(kind(status, message), wanted, "{status} {message}");
        }
    }
}
