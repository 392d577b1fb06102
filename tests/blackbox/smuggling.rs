//! Request smuggling: bodies whose end two readers could see in different places; and the timing of a 401.

use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::support::{Server, shared_server};

/// Sends a request on a connection of its own, which stays open, and returns all that comes back.
async fn answers(server: &Server, request: &str) -> String {
    let mut stream = TcpStream::connect(server.url.trim_start_matches("http://")).await.unwrap();
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut bytes = Vec::new();
    // A smuggled request would be answered at once.
    let quiet = Duration::from_millis(400);
    let mut chunk = [0; 4096];
    while let Ok(Ok(read @ 1..)) = tokio::time::timeout(quiet, stream.read(&mut chunk)).await {
        bytes.extend(&chunk[..read]);
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

fn statuses(answers: &str) -> Vec<&str> {
    let starts = answers.match_indices("HTTP/1.1 ");
    starts.map(|(at, _)| &answers[at + 9..at + 12]).collect()
}

#[tokio::test]
async fn an_ambiguous_body_length_smuggles_no_request() {
    let (server, _) = shared_server();
    let smuggled = "GET /smuggled HTTP/1.1\r\nhost: x\r\n\r\n";
    let post = |framing: &str, body: &str| {
        format!(
            "POST /localize?map=m HTTP/1.1\r\nhost: x\r\ncontent-type: image/jpeg\r\n{framing}\r\n\r\n{body}"
        )
    };
    let chunked = format!("0\r\n\r\n{smuggled}");
    let all = chunked.len();
    for framing in [
        // Both kinds of length: a proxy that uses the other one sees one request.
        format!("content-length: {all}\r\ntransfer-encoding: chunked"),
        format!("transfer-encoding: chunked\r\ncontent-length: {all}"),
        // Two lengths.
        format!("content-length: {all}\r\ncontent-length: 5"),
        format!("content-length: 5\r\ncontent-length: {all}"),
        format!("content-length: 5, {all}"),
        // Lengths that some parsers accept.
        "content-length: +5".into(),
        "content-length: 0x5".into(),
        "content-length: -1".into(),
        "content-length: 5 5".into(),
        "content-length:".into(),
        "content-length : 5".into(),
        "content-length\t: 5".into(),
        // Encodings that some parsers accept.
        "transfer-encoding: xchunked".into(),
        "transfer-encoding: chunked, identity".into(),
        "transfer-encoding: identity".into(),
        "transfer-encoding : chunked".into(),
        "transfer-encoding: chunked\r\ntransfer-encoding: identity".into(),
        "transfer-encoding: \x0bchunked".into(),
        // Folded headers, and bare line endings.
        " continued: yes\r\ncontent-length: 5".into(),
        "x: y\r\n content-length: 5".into(),
        "x: y\rcontent-length: 5".into(),
        "x: y\0\r\ncontent-length: 5".into(),
    ] {
        let got = answers(server, &post(&framing, &chunked)).await;
        let statuses = statuses(&got);
        assert_eq!(statuses.len(), 1, "{framing:?}: {got}");
        assert!(statuses[0].starts_with('4') || statuses[0].starts_with('5'), "{framing:?}: {got}");
        assert!(!got.contains("/smuggled"), "{framing:?}: {got}");
    }
    for chunks in [
        "5;x\r\nabc",
        "-1\r\n",
        "+5\r\nabcde\r\n0\r\n\r\n",
        "0x5\r\nabcde\r\n0\r\n\r\n",
        "FFFFFFFFFFFFFFFFF\r\n",
        "5\r\nabcdeX\r\n0\r\n\r\n",
        "\r\n5\r\nabcde\r\n0\r\n\r\n",
    ] {
        let got =
            answers(server, &post("transfer-encoding: chunked", &format!("{chunks}{smuggled}")))
                .await;
        assert!(statuses(&got).len() <= 1 && !got.contains("/smuggled"), "{chunks:?}: {got}");
    }
    // Two pipelined requests get two responses.
    let two = format!("GET /livez HTTP/1.1\r\nhost: x\r\n\r\n{smuggled}");
    let got = answers(server, &two).await;
    assert_eq!(statuses(&got), ["200", "404"], "{got}");
}

/// Timing, which must not depend on how busy a database is.
mod embedded_only {
    use std::time::Instant;

    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpStream;

    use crate::support::{BINARY, Server};

    /// The median response time for each of several keys, measured in turn.
    async fn medians(server: &Server, keys: &[String], rounds: usize) -> Vec<f64> {
        let mut stream =
            TcpStream::connect(server.url.trim_start_matches("http://")).await.unwrap();
        stream.set_nodelay(true).unwrap();
        let mut times = vec![Vec::with_capacity(rounds); keys.len()];
        let mut answer = [0; 4096];
        for round in 0..rounds {
            for turn in 0..keys.len() {
                let of = (round + turn) % keys.len();
                let request = format!(
                    "GET /maps HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {}\r\n\r\n",
                    keys[of]
                );
                let begun = Instant::now();
                stream.write_all(request.as_bytes()).await.unwrap();
                let read = stream.read(&mut answer).await.unwrap();
                times[of].push(begun.elapsed().as_secs_f64() * 1e6);
                assert!(answer[..read].starts_with(b"HTTP/1.1 401 "));
            }
        }
        times
            .iter_mut()
            .map(|times| {
                times.sort_by(f64::total_cmp);
                times[times.len() / 2]
            })
            .collect()
    }

    #[tokio::test]
    async fn a_401_takes_the_same_time_however_much_of_the_key_is_right() {
        let dir = tempfile::tempdir().unwrap();
        let output = std::process::Command::new(&*BINARY)
            .args(["keys", "create", "--name", "a", "--role", "robot", "--data"])
            .arg(dir.path())
            .output()
            .unwrap();
        let right = String::from_utf8(output.stdout).unwrap().trim().to_owned();
        let server = Server::start(dir.path(), &[("WHEREABOUTS_AUTH__KEYS", "required")]);
        let changed = |at: usize| {
            let digit = if right.as_bytes()[at] == b'0' { "1" } else { "0" };
            let mut key = right.clone();
            key.replace_range(at..=at, digit);
            key
        };
        // Wrong in the last digit (twice: their difference is the noise), in the first digit of the secret, and in the
        // id, so that there is no such key.
        let (last, first, id) = (right.len() - 1, 17, 5);
        let keys = [changed(last), changed(last), changed(first), changed(id)];
        medians(&server, &keys, 200).await;
        let medians = medians(&server, &keys, 1500).await;
        println!(
            "medians in µs, of a key that is wrong at the end (twice), at the start, and unknown: {medians:.1?}"
        );
        let (base, noise) = (medians[0], (medians[0] - medians[1]).abs());
        for other in &medians[2..] {
            assert!((other - base).abs() < 0.15 * base + 3.0 * noise, "{medians:?}");
        }
    }
}
