//! `X-Deadline-Ms` and `grpc-timeout`: how long a client is willing to wait for an answer.

use std::time::Duration;

use axum::http::{HeaderMap, HeaderName};

use super::problem::Problem;
use whereabouts_api::ErrorKind;

/// Milliseconds from the arrival of the request's head.
const DEADLINE: HeaderName = HeaderName::from_static("x-deadline-ms");

/// Longest wait that a client can set; no request may take as long.
const LONGEST_MS: u64 = 3_600_000;

/// The timeout of a gRPC call: up to eight digits and a unit.
const GRPC_TIMEOUT: HeaderName = HeaderName::from_static("grpc-timeout");

/// How long the client waits at most, by its headers.
pub(super) fn requested(headers: &HeaderMap) -> Result<Option<Duration>, Problem> {
    if let Some(value) = headers.get(GRPC_TIMEOUT) {
        let wait = value.to_str().ok().and_then(grpc_timeout);
        return wait.map(Some).ok_or_else(|| {
            let detail =
                format!("grpc-timeout is {value:?}; it must be up to 8 digits and one of HMSmun");
            Problem::new(ErrorKind::Malformed, detail)
        });
    }
    let Some(value) = headers.get(DEADLINE) else { return Ok(None) };
    let milliseconds = value.to_str().ok().and_then(|text| text.parse::<u64>().ok());
    match milliseconds {
        Some(wait @ 1..=LONGEST_MS) => Ok(Some(Duration::from_millis(wait))),
        _ => Err(Problem::new(
            ErrorKind::Malformed,
            format!(
                "X-Deadline-Ms is {value:?}; it must be a whole number of milliseconds from 1 to \
                 {LONGEST_MS}"
            ),
        )),
    }
}

fn grpc_timeout(text: &str) -> Option<Duration> {
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    if !(1..=8).contains(&digits.len()) || !digits.bytes().all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    let amount: u64 = digits.parse().ok()?;
    Some(match unit {
        "H" => Duration::from_secs(amount * 3600),
        "M" => Duration::from_secs(amount * 60),
        "S" => Duration::from_secs(amount),
        "m" => Duration::from_millis(amount),
        "u" => Duration::from_micros(amount),
        "n" => Duration::from_nanos(amount),
        _ => return None,
    })
}

/// The problem of a request that was abandoned because its deadline passed.
pub(super) fn passed(wait: Duration) -> Problem {
    Problem::new(
        ErrorKind::DeadlinePassed,
        format!(
            "the deadline of {} ms (X-Deadline-Ms, grpc-timeout) has passed, and the request was abandoned; \
             allow more time, or send a newer frame",
            wait.as_millis()
        ),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grpc_timeout_has_digits_and_a_unit() {
        assert_eq!(grpc_timeout("250m"), Some(Duration::from_millis(250)));
        assert_eq!(grpc_timeout("99999999H"), Some(Duration::from_secs(99_999_999 * 3600)));
        for bad in ["", "S", "5", "123456789S", "-1S", "+1S", "5s", "5é"] {
            assert_eq!(grpc_timeout(bad), None, "{bad}");
        }
    }
}
