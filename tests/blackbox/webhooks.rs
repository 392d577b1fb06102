//! Webhooks: deliveries, signatures, retries, and addresses that are rejected.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::deployment;
use super::receiver::{Receiver, Reply};
use super::support::{Answer, BINARY, Server, frame};
use super::wait::{eventually, eventually_within, until};

const PRIVATE: (&str, &str) = ("WHEREABOUTS_WEBHOOKS__ALLOW_PRIVATE", "true");
const NO_RETRY: (&str, &str) = ("WHEREABOUTS_WEBHOOKS__RETRY_S", "[]");

/// Creates a webhook; returns its id and its secret.
async fn hook(server: &Server, webhook: Value) -> (String, String) {
    let request = server.request(Method::POST, "/webhooks").json(&webhook);
    let made = Answer::of(request).await.expect(201);
    let text = |field: &str| made[field].as_str().unwrap().to_owned();
    (text("id"), text("secret"))
}

async fn post(server: &Server, path: &str) -> Answer {
    Answer::of(server.request(Method::POST, path)).await
}

/// Waits until the newest delivery of a webhook is in this state, and returns it.
async fn newest(server: &Server, id: &str, state: &str, attempts: u32) -> Value {
    eventually_within(Duration::from_secs(30), async || {
        let page = server.get(&format!("/webhooks/{id}/deliveries?limit=1")).await.expect(200);
        let newest = page["deliveries"][0].clone();
        match newest["state"] == state && newest["attempts"] == attempts {
            true => Ok(newest),
            false => Err(newest),
        }
    })
    .await
}

/// A job that has ended.
async fn job(server: &Server, map: &str) -> Value {
    let path = format!("/localize?map={map}&refine=wait");
    let answer = server.post_jpeg(&path, frame(0, 0)).await.expect(200);
    server.get(answer["job"]["href"].as_str().unwrap()).await.expect(200)
}

#[tokio::test]
async fn the_end_of_a_job_is_delivered_signed_to_the_subscribed_webhooks() {
    let dir = TempDir::new().unwrap();
    // A proxy could reach addresses that the server must not.
    let proxy = ("HTTP_PROXY", "http://127.0.0.1:9");
    let settings = [PRIVATE, proxy, ("http_proxy", proxy.1), ("WHEREABOUTS_LOG__FILTER", "debug")];
    let server = Server::start(dir.path(), &settings);
    server.town("m", 2).await;
    job(&server, "m").await;
    let (all, failures) = (Receiver::start([]).await, Receiver::start([]).await);
    let (id, secret) = hook(&server, json!({"url": all.url})).await;
    hook(&server, json!({"url": failures.url, "events": ["job.failed"]})).await;
    hook(&server, json!({"url": failures.url, "map": "other"})).await;
    let job = job(&server, "m").await;

    let messages = all.wait(1).await;
    messages[0].verify(&secret);
    let message = messages[0].json();
    assert_eq!((&message["type"], &message["data"]), (&json!("job.succeeded"), &job));
    assert_eq!(message["timestamp"], job["finished_at"]);
    assert_eq!(messages[0].path, "/hook?token=of-the-url");
    assert_eq!(messages[0].header("content-type"), "application/json");
    assert!(messages[0].header("user-agent").starts_with("whereabouts/"));
    let delivery = newest(&server, &id, "delivered", 1).await;
    assert_eq!(delivery["id"], messages[0].header("webhook-id"));
    assert_eq!((&delivery["job"], &delivery["last_status"]), (&job["id"], &json!(200)));
    assert!(delivery["last_error"].is_null() && delivery["next_attempt_at"].is_null());

    post(&server, &format!("/webhooks/{id}/test")).await.expect(202);
    let ping = all.wait(2).await[1].clone();
    ping.verify(&secret);
    assert_eq!((&ping.json()["type"], &ping.json()["data"]["id"]), (&json!("ping"), &json!(id)));
    assert!(failures.messages().is_empty());
    let page = server.get(&format!("/webhooks/{id}/deliveries?limit=1")).await.expect(200);
    let cursor = page["next_cursor"].as_str().unwrap();
    let path = format!("/webhooks/{id}/deliveries?limit=1&cursor={cursor}&state=delivered");
    let page = server.get(&path).await.expect(200);
    assert_eq!((&page["deliveries"][0], &page["next_cursor"]), (&delivery, &Value::Null));

    newest(&server, &id, "delivered", 1).await;
    let metrics = server.metrics().await;
    for line in [
        "whereabouts_webhook_attempts_total{outcome=\"delivered\"} 2",
        "whereabouts_webhook_deliveries_waiting 0",
    ] {
        assert!(metrics.contains(line), "{metrics}");
    }
    let shown = server.get("/webhooks").await.expect(200);
    assert_eq!(shown["webhooks"].as_array().unwrap().len(), 3);
    let shown = format!("{shown} {}", server.get(&format!("/webhooks/{id}")).await.expect(200));
    assert!(!shown.contains(&secret[6..]), "the secret is shown again");
    let log = server.log();
    assert!(log.contains("a message was delivered"));
    assert!(!log.contains(&secret[6..]) && !log.contains("of-the-url"), "a secret is in the log");

    server.delete(&format!("/webhooks/{id}")).await.expect(204);
    server.delete(&format!("/webhooks/{id}")).await.problem(404);
    for path in ["", "/deliveries"] {
        server.get(&format!("/webhooks/{id}{path}")).await.problem(404);
    }
    post(&server, &format!("/webhooks/{id}/test")).await.problem(404);
}

#[tokio::test]
async fn a_failed_delivery_is_retried_with_the_same_id_and_body() {
    let dir = TempDir::new().unwrap();
    let retry = ("WHEREABOUTS_WEBHOOKS__RETRY_S", "[0, 0, 5]");
    let server =
        Server::start(dir.path(), &[PRIVATE, retry, ("WHEREABOUTS_WEBHOOKS__TIMEOUT_S", "1")]);
    let busy = Reply::With(503, "retry-after", "2".into());
    let receiver = Receiver::start([Reply::Status(500), busy, Reply::Silence]).await;
    let (id, secret) = hook(&server, json!({"url": receiver.url})).await;
    post(&server, &format!("/webhooks/{id}/test")).await.expect(202);
    receiver.wait(2).await;
    let start = Instant::now();
    receiver.wait(3).await;
    assert!(start.elapsed() > Duration::from_millis(1500), "Retry-After was not waited for");
    let waiting = newest(&server, &id, "waiting", 3).await;
    assert!(waiting["last_error"].as_str().unwrap().contains("webhooks.timeout_s"), "{waiting}");
    assert!(waiting["last_status"].is_null());
    let messages = receiver.wait(4).await;
    for message in &messages {
        message.verify(&secret);
        assert_eq!(message.body, messages[0].body);
        assert_eq!(message.header("webhook-id"), messages[0].header("webhook-id"));
    }
    assert_ne!(messages[0].header("webhook-timestamp"), messages[2].header("webhook-timestamp"));
    newest(&server, &id, "delivered", 4).await;
}

#[tokio::test]
async fn a_dead_delivery_is_kept_and_can_be_redelivered() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[PRIVATE, ("WHEREABOUTS_WEBHOOKS__RETRY_S", "[0]")]);
    let (unreachable, _) = hook(&server, json!({"url": "http://127.0.0.1:1/"})).await;
    post(&server, &format!("/webhooks/{unreachable}/test")).await.expect(202);
    let dead = newest(&server, &unreachable, "dead", 2).await;
    assert!(dead["last_error"].as_str().unwrap().contains("refused"), "{dead}");
    assert!(dead["last_status"].is_null() && dead["ended_at"].is_string());
    let receiver = Receiver::start([Reply::Status(500), Reply::Status(404)]).await;
    let (id, secret) = hook(&server, json!({"url": receiver.url})).await;
    post(&server, &format!("/webhooks/{id}/test")).await.expect(202);
    let dead = newest(&server, &id, "dead", 2).await;
    assert_eq!(dead["last_status"], 404);
    assert!(dead["last_error"].as_str().unwrap().contains("404"), "{dead}");
    assert!(server.log().contains("a message was given up"));
    let listed = server.get(&format!("/webhooks/{id}/deliveries?state=dead")).await.expect(200);
    assert_eq!(listed["deliveries"], json!([dead]));

    let path = format!("/webhooks/{id}/deliveries/{}/redeliver", dead["id"].as_str().unwrap());
    let queued = post(&server, &path).await.expect(202);
    assert_eq!((&queued["state"], &queued["attempts"]), (&json!("waiting"), &json!(0)));
    let again = receiver.wait(3).await[2].clone();
    again.verify(&secret);
    assert_eq!(again.header("webhook-id"), dead["id"]);
    newest(&server, &id, "delivered", 1).await;
    let wrong = format!("/webhooks/{id}/deliveries/{id}/redeliver");
    assert!(post(&server, &wrong).await.problem(404).contains("webhooks.keep_days"));
    server.kill();

    // A waiting delivery is not queued again.
    let server = Server::start(dir.path(), &[PRIVATE, ("WHEREABOUTS_WEBHOOKS__RETRY_S", "[3600]")]);
    receiver.replies.lock().unwrap().push_back(Reply::Status(500));
    post(&server, &path).await.expect(202);
    let waiting = newest(&server, &id, "waiting", 1).await;
    assert!(waiting["next_attempt_at"].is_string() && waiting["ended_at"].is_null());
    assert!(post(&server, &path).await.problem(409).contains("waits anyway"));
    server.kill();

    // The number of deliveries is bounded.
    let few = [PRIVATE, ("WHEREABOUTS_WEBHOOKS__MAX_DELIVERIES", "1")];
    let server = Server::start(dir.path(), &few);
    let (other, _) = hook(&server, json!({"url": receiver.url})).await;
    post(&server, &format!("/webhooks/{other}/test")).await.expect(202);
    newest(&server, &other, "delivered", 1).await;
    until(async || {
        let page = server.get(&format!("/webhooks/{other}/deliveries")).await.expect(200);
        page["deliveries"] == json!([])
    })
    .await;
}

#[tokio::test]
async fn redirects_are_not_followed() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[PRIVATE, NO_RETRY]);
    let elsewhere = Receiver::start([]).await;
    let replies = [301, 302, 303, 307, 308]
        .map(|status| Reply::With(status, "location", elsewhere.url.clone()));
    let receiver = Receiver::start(replies).await;
    let (id, _) = hook(&server, json!({"url": receiver.url})).await;
    for status in [301, 302, 303, 307, 308] {
        post(&server, &format!("/webhooks/{id}/test")).await.expect(202);
        let dead = eventually(async || {
            let dead = newest(&server, &id, "dead", 1).await;
            (dead["last_status"] == status).then_some(dead)
        })
        .await;
        assert!(dead["last_error"].as_str().unwrap().contains("redirects are not followed"));
    }
    assert_eq!((receiver.messages().len(), elsewhere.messages().len()), (5, 0));
}

#[tokio::test]
async fn private_addresses_are_rejected_unless_allowed() {
    let dir = TempDir::new().unwrap();
    let receiver = Receiver::start([]).await;
    let server = Server::start(dir.path(), &[PRIVATE]);
    // A host name and a literal address, both created while private addresses were allowed.
    let named = receiver.url.replace("127.0.0.1", "localhost");
    let (by_name, _) = hook(&server, json!({"url": named})).await;
    let (by_address, _) = hook(&server, json!({"url": receiver.url})).await;
    post(&server, &format!("/webhooks/{by_name}/test")).await.expect(202);
    receiver.wait(1).await;
    newest(&server, &by_name, "delivered", 1).await;
    server.kill();

    let server = Server::start(dir.path(), &[NO_RETRY]);
    for id in [&by_name, &by_address] {
        post(&server, &format!("/webhooks/{id}/test")).await.expect(202);
        let dead = newest(&server, id, "dead", 1).await;
        let why = dead["last_error"].as_str().unwrap();
        assert!(why.contains("webhooks.allow_private"), "{why}");
    }
    assert_eq!(receiver.messages().len(), 1);
    let refuse = async |webhook: Value, status| {
        Answer::of(server.request(Method::POST, "/webhooks").json(&webhook)).await.problem(status)
    };
    for url in [
        receiver.url.as_str(),
        &named,
        "http://10.0.0.1/",
        "http://169.254.169.254/latest/meta-data/",
        "http://2130706433/",
        "http://0x7f.1/",
        "http://017700000001/",
        "https://[::1]/",
        "https://[::ffff:127.0.0.1]/",
        "https://[fe80::1]/",
    ] {
        let why = refuse(json!({"url": url}), 422).await;
        assert!(why.contains("webhooks.allow_private"), "{url}: {why}");
    }
    for url in
        ["", "no url", "ftp://example.com/", "https://u:p@example.com/", "https://example.com/#x"]
    {
        refuse(json!({"url": url}), 422).await;
    }
    for events in [json!([]), json!(["ping"])] {
        refuse(json!({"url": "https://example.com/", "events": events}), 422).await;
    }
    for wrong in [
        json!({}),
        json!({"url": 5}),
        json!({"url": "https://example.com/", "events": ["job.began"]}),
        json!({"url": "https://example.com/", "map": "no map/"}),
        json!({"url": "https://example.com/", "secret": "mine"}),
    ] {
        refuse(wrong, 400).await;
    }
    let (public, _) = hook(&server, json!({"url": "https://example.com/hook"})).await;
    let shown = server.get(&format!("/webhooks/{public}")).await.expect(200);
    let ends = json!(["job.succeeded", "job.degraded", "job.failed", "job.cancelled"]);
    assert_eq!((&shown["events"], &shown["map"]), (&ends, &Value::Null));
    // The response holds a secret, so it is not stored.
    let keyed = server.request(Method::POST, "/webhooks").header("idempotency-key", "one");
    let keyed = keyed.json(&json!({"url": "https://example.com/"}));
    Answer::of(keyed).await.problem(400);
}

#[tokio::test]
async fn a_receiver_that_answers_410_is_disabled() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[PRIVATE, ("WHEREABOUTS_WEBHOOKS__MAX", "1")]);
    let receiver = Receiver::start([Reply::Status(410)]).await;
    let (id, _) = hook(&server, json!({"url": receiver.url})).await;
    let full = server.request(Method::POST, "/webhooks").json(&json!({"url": receiver.url}));
    assert!(Answer::of(full).await.problem(409).contains("webhooks.max"));
    post(&server, &format!("/webhooks/{id}/test")).await.expect(202);
    let dead = newest(&server, &id, "dead", 1).await;
    assert!(dead["last_error"].as_str().unwrap().contains("410"), "{dead}");
    let shown = server.get(&format!("/webhooks/{id}")).await.expect(200);
    assert!(shown["disabled_at"].is_string(), "{shown}");
    assert!(shown["disabled_reason"].as_str().unwrap().contains("410"), "{shown}");
    let again = format!("/webhooks/{id}/deliveries/{}/redeliver", dead["id"].as_str().unwrap());
    for path in [format!("/webhooks/{id}/test"), again] {
        assert!(post(&server, &path).await.problem(409).contains("disabled"));
    }
    assert_eq!(receiver.messages().len(), 1);
}

#[tokio::test]
async fn no_delivery_is_lost_when_the_server_is_killed() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[PRIVATE]);
    server.town("m", 2).await;
    let receiver = Receiver::start([Reply::Silence, Reply::Silence, Reply::Silence]).await;
    let (_, secret) = hook(&server, json!({"url": receiver.url})).await;
    let mut jobs = Vec::new();
    for _ in 0..3 {
        jobs.push(job(&server, "m").await["id"].as_str().unwrap().to_owned());
    }
    // The first deliveries are in flight and unanswered; the last one may be.
    server.kill();
    receiver.replies.lock().unwrap().clear();
    let before = receiver.messages().len();

    let _server = Server::start(dir.path(), &[PRIVATE]);
    let messages = receiver.wait(before + jobs.len()).await;
    let mut delivered: Vec<String> = messages[before..]
        .iter()
        .map(|message| {
            message.verify(&secret);
            message.json()["data"]["id"].as_str().unwrap().to_owned()
        })
        .collect();
    delivered.sort();
    assert_eq!(delivered, jobs);
}

#[tokio::test]
async fn a_slow_receiver_delays_neither_others_nor_shutdown() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[PRIVATE, ("WHEREABOUTS_WEBHOOKS__TIMEOUT_S", "120")]);
    let slow = Receiver::start(vec![Reply::Silence; 100]).await;
    let quick = Receiver::start([]).await;
    let (slow_id, _) = hook(&server, json!({"url": slow.url})).await;
    let (quick_id, _) = hook(&server, json!({"url": quick.url})).await;
    for _ in 0..30 {
        post(&server, &format!("/webhooks/{slow_id}/test")).await.expect(202);
    }
    slow.wait(4).await;
    for _ in 0..10 {
        post(&server, &format!("/webhooks/{quick_id}/test")).await.expect(202);
    }
    quick.wait(10).await;
    assert_eq!(slow.messages().len(), 4, "webhooks.concurrency_each");
    let start = Instant::now();
    assert!(server.terminate().success());
    assert!(start.elapsed() < Duration::from_secs(15), "the shutdown took {:?}", start.elapsed());
}

/// Creates a key in the data folder of a server that is not running.
fn key(data: &Path, role: &str) -> String {
    let mut command = Command::new(&*BINARY);
    command.args(["keys", "create", "--name", "test", "--role", role, "--data"]).arg(data);
    command.envs(deployment::settings(data));
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

#[tokio::test]
async fn only_admins_manage_webhooks() {
    let dir = TempDir::new().unwrap();
    let (admin, operator) = (key(dir.path(), "admin"), key(dir.path(), "operator"));
    let settings = [PRIVATE, ("WHEREABOUTS_AUTH__KEYS", "required")];
    let server = Server::start(dir.path(), &settings);
    let webhook = json!({"url": "https://example.com/"});
    let make = || server.request(Method::POST, "/webhooks").json(&webhook);
    let made = Answer::of(make().bearer_auth(&admin)).await.expect(201);
    let id = made["id"].as_str().unwrap();
    Answer::of(make()).await.problem(401);
    Answer::of(make().bearer_auth(&operator)).await.problem(403);
    for (method, path) in [
        (Method::GET, "/webhooks".to_owned()),
        (Method::GET, format!("/webhooks/{id}")),
        (Method::GET, format!("/webhooks/{id}/deliveries")),
        (Method::POST, format!("/webhooks/{id}/test")),
        (Method::POST, format!("/webhooks/{id}/deliveries/{id}/redeliver")),
        (Method::DELETE, format!("/webhooks/{id}")),
    ] {
        Answer::of(server.request(method.clone(), &path)).await.problem(401);
        let as_operator = server.request(method, &path).bearer_auth(&operator);
        Answer::of(as_operator).await.problem(403);
    }
    let shown = server.request(Method::GET, &format!("/webhooks/{id}")).bearer_auth(&admin);
    Answer::of(shown).await.expect(200);
    let log = server.log();
    assert!(log.contains("a webhook was made"));
    assert!(!log.contains(&made["secret"].as_str().unwrap()[6..]), "the secret is in the log");
}
