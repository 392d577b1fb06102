//! Several servers and workers share a database: what happens when processes die, and when the database dies.
//!
//! These need WHEREABOUTS_TEST_DEPLOYMENT=scale-out; `make scale-out` runs them with `--include-ignored`.

use std::time::Duration;

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::mock_mllm::{MockMllm, Reply, Script};
use crate::support::{Server, frame};
use crate::wait::eventually_within;

/// Concurrent calls of one process to the mock.
const CONCURRENCY: usize = 8;

/// Settings of every process; a process without heartbeats is soon considered dead.
fn settings(mock: &MockMllm) -> Vec<(&'static str, String)> {
    let given = [
        ("WHEREABOUTS_REFINE__REFINER", "mllm"),
        ("WHEREABOUTS_MLLM__REQUESTS_PER_MINUTE", "0"),
        ("WHEREABOUTS_MLLM__BREAKER_FAILURES", "1000"),
        ("WHEREABOUTS_JOBS__ATTEMPTS", "10"),
        ("WHEREABOUTS_JOBS__RETRY_PAUSE_S", "0"),
        ("WHEREABOUTS_DATABASE__TIMEOUT_MS", "1000"),
        ("WHEREABOUTS_DATABASE__LIFETIME_S", "2"),
    ];
    let mut settings: Vec<_> = given.into_iter().map(|(key, value)| (key, value.into())).collect();
    settings.push(("WHEREABOUTS_MLLM__BASE_URL", mock.url()));
    settings.push(("WHEREABOUTS_MLLM__CONCURRENCY", CONCURRENCY.to_string()));
    settings
}

fn with<'a>(
    settings: &'a [(&'static str, String)],
    more: &[(&'static str, &'a str)],
) -> Vec<(&'static str, &'a str)> {
    let given = settings.iter().map(|(key, value)| (*key, value.as_str()));
    given.chain(more.iter().copied()).collect()
}

fn serve(dir: &TempDir, settings: &[(&'static str, String)]) -> Server {
    Server::start(dir.path(), &with(settings, &[("WHEREABOUTS_JOBS__WORKERS", "0")]))
}

fn worker(dir: &TempDir, settings: &[(&'static str, String)]) -> Server {
    Server::start_worker(dir.path(), &with(settings, &[("WHEREABOUTS_JOBS__WORKERS", "2")]))
}

#[tokio::test]
#[ignore = "needs the scale-out deployment"]
async fn two_workers_that_need_the_same_pair_pay_for_it_once() {
    let dir = TempDir::new().unwrap();
    let script = Script { latency: Duration::from_millis(300), ..Script::default() };
    let mock = MockMllm::start(script).await;
    let settings = settings(&mock);
    let server = serve(&dir, &settings);
    let _workers: Vec<Server> = (0..2).map(|_| worker(&dir, &settings)).collect();
    server.town("m", 10).await;
    let mut ids = Vec::new();
    for _ in 0..4 {
        let answer = server.post_jpeg("/localize?map=m", frame(3, 0)).await.expect(200);
        ids.push(answer["job"]["id"].as_str().unwrap().to_owned());
    }
    for id in ids {
        let job = server.get(&format!("/jobs/{id}?wait=30")).await.expect(200);
        assert_eq!(job["state"], "succeeded", "{job}");
    }
    assert_eq!((mock.describe_calls(), mock.asked_again()), (10, 0));
}

#[tokio::test]
#[ignore = "needs the scale-out deployment"]
async fn a_worker_claims_no_more_jobs_than_keep_its_calls_busy() {
    const JOBS: usize = 14;
    const PAIRS: usize = 5;
    // Enough to keep all calls busy and half as many ready, the one that exceeds them, and one for each of the two turns.
    const MOST: usize = (CONCURRENCY + CONCURRENCY / 2) / PAIRS + 3;
    let dir = TempDir::new().unwrap();
    let script = Script { describe: Box::new(|_| Reply::Hang), ..Script::default() };
    let mock = MockMllm::start(script).await;
    let settings = settings(&mock);
    let server = serve(&dir, &settings);
    server.town("m", PAIRS).await;
    for place in 0..JOBS {
        server.post_jpeg("/localize?map=m", frame(place, 0)).await.expect(200);
    }
    let mut workers = Vec::new();
    for number in 1..=2 {
        workers.push(worker(&dir, &settings));
        let running = eventually_within(Duration::from_secs(20), async || {
            let running = server.get("/jobs?state=running").await.expect(200);
            let running = running["jobs"].as_array().unwrap().len();
            let busy = mock.in_flight() == number * CONCURRENCY;
            if busy {
                Ok(running)
            } else {
                Err(format!("{running} jobs, {} calls", mock.in_flight()))
            }
        })
        .await;
        assert!((2 * number..=MOST * number).contains(&running), "{running}");
    }
}

#[tokio::test]
#[ignore = "needs the scale-out deployment"]
async fn a_change_at_one_server_is_visible_at_the_other() {
    let dir = TempDir::new().unwrap();
    let (one, other) = (Server::start(dir.path(), &[]), Server::start(dir.path(), &[]));
    one.town("m", 5).await;
    let answer = other.post_jpeg("/localize?map=m&refine=wait", frame(2, 0)).await.expect(200);
    assert_eq!(answer["candidates"][0]["image_id"], "place-2");
    let id = answer["job"]["id"].as_str().unwrap();
    let job = one.get(&format!("/jobs/{id}")).await.expect(200);
    assert_eq!(job["state"], "succeeded");
    other.delete("/maps/m/images/place-2").await.expect(204);
    let answer = one.post_jpeg("/localize?map=m&refine=off", frame(2, 0)).await.expect(200);
    assert_ne!(answer["candidates"][0]["image_id"], "place-2");
    other.delete("/maps/m").await.expect(204);
    one.post_jpeg("/localize?map=m&refine=off", frame(2, 0)).await.problem(404);
}

#[tokio::test]
#[ignore = "needs the scale-out deployment"]
async fn a_key_revoked_at_one_server_is_rejected_by_the_other() {
    let dir = TempDir::new().unwrap();
    let make = |server: &Server, role: &str| {
        let request = server.request(reqwest::Method::POST, "/keys");
        request.json(&json!({ "name": role, "role": role }))
    };
    let (one, other) = (Server::start(dir.path(), &[]), Server::start(dir.path(), &[]));
    let admin = make(&one, "admin").send().await.unwrap().json::<Value>().await.unwrap();
    let robot = make(&one, "robot").send().await.unwrap().json::<Value>().await.unwrap();
    drop((one, other));
    let keys = [("WHEREABOUTS_AUTH__KEYS", "required")];
    let (one, other) = (Server::start(dir.path(), &keys), Server::start(dir.path(), &keys));
    let get = |server: &Server, key: &Value| {
        let token = key["token"].as_str().unwrap().to_owned();
        server.request(reqwest::Method::GET, "/maps").bearer_auth(token).send()
    };
    assert_eq!(get(&other, &robot).await.unwrap().status(), 200);
    let path = format!("/keys/{}", robot["key"]["id"].as_str().unwrap());
    let revoke = one.request(reqwest::Method::DELETE, &path);
    let revoked = revoke.bearer_auth(admin["token"].as_str().unwrap()).send().await.unwrap();
    assert_eq!(revoked.status(), 200);
    eventually_within(Duration::from_secs(2), async || {
        match get(&other, &robot).await.unwrap().status().as_u16() {
            401 => Ok(()),
            status => Err(format!("the other server still answers {status}")),
        }
    })
    .await;
}

/// What a server says of the next frame of a track.
async fn track_of(server: &Server, place: usize) -> Value {
    let at = format!("2026-03-01T12:00:{:02}Z", 2 * place);
    let path = format!("/localize?map=m&refine=off&track=r&captured_at={at}");
    server.post_jpeg(&path, frame(place, 0)).await.expect(200)["track"].take()
}

#[tokio::test]
#[ignore = "needs the scale-out deployment"]
async fn any_server_continues_a_track_also_after_one_is_killed() {
    let dir = TempDir::new().unwrap();
    let (one, other) = (Server::start(dir.path(), &[]), Server::start(dir.path(), &[]));
    one.town("m", 24).await;
    for place in 0..12 {
        let track = track_of([&one, &other][place % 2], place).await;
        assert_eq!(track["frames"], place + 1, "{track}");
    }
    for server in [&one, &other] {
        let tracks = server.get("/maps/m/tracks").await.expect(200);
        assert_eq!(tracks["tracks"][0]["frames"], 12, "{tracks}");
        let way = server.get("/maps/m/tracks/r").await.expect(200);
        assert_eq!(way["places"].as_array().unwrap().len(), 12, "{way}");
    }
    one.kill();
    let track = track_of(&other, 12).await;
    assert_eq!((&track["frames"], &track["image_id"]), (&json!(13), &json!("place-12")), "{track}");
    let one = Server::start(dir.path(), &[]);
    let track = track_of(&one, 13).await;
    assert_eq!((&track["frames"], &track["image_id"]), (&json!(14), &json!("place-13")), "{track}");
    // Both know of each frame, also of those that they take at the same time.
    let frames = (14..22).map(|place| track_of([&one, &other][place % 2], place));
    futures_util::future::join_all(frames).await;
    let track = track_of(&one, 22).await;
    assert_eq!(track["frames"], 23, "{track}");
}

#[test]
#[ignore = "needs the scale-out deployment"]
fn a_worker_serves_health_and_metrics_only() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let dir = TempDir::new().unwrap();
    let worker = Server::start_worker(dir.path(), &[]);
    runtime.block_on(async {
        for path in ["/livez", "/readyz", "/metrics"] {
            assert_eq!(worker.get(path).await.status, 200, "{path}");
        }
        for path in ["/maps", "/jobs", "/", "/localize"] {
            worker.get(path).await.problem(404);
        }
    });
    assert!(worker.terminate().success());
}

/// Tests that disturb all others: `tests/scale_out.sh` runs them on their own.
mod alone {
    use std::collections::HashSet;
    use std::process::Command;
    use std::time::{Duration, Instant};

    use serde_json::Value;
    use tempfile::TempDir;

    use super::{CONCURRENCY, serve, settings, worker};
    use crate::deployment;
    use crate::mock_mllm::{MockMllm, Script};
    use crate::support::{Server, frame};
    use crate::wait::eventually_within;

    /// Stops, kills or starts the PostgreSQL of these tests.
    fn database(what: &str) {
        let control = std::env::var("WHEREABOUTS_TEST_POSTGRES").expect(
            "this test stops PostgreSQL and starts it again: run it through tests/postgres.sh",
        );
        let done = Command::new(control).arg(what).output().unwrap();
        assert!(done.status.success(), "{done:?}");
    }

    async fn ended(server: &Server, jobs: usize) -> Vec<Value> {
        let mut all = Vec::new();
        for state in ["succeeded", "degraded", "failed"] {
            let path = format!("/jobs?state={state}&limit={jobs}&brief=true");
            let answer = server.get(&path).await;
            if answer.status == 200 {
                all.extend(answer.expect(200)["jobs"].as_array().unwrap().clone());
            }
        }
        all
    }

    /// Posts a frame until a server accepts it; a server that cannot must answer 503 soon.
    async fn localize(servers: &[Server], number: usize) -> Value {
        let mut attempts = 0..;
        eventually_within(Duration::from_secs(60), async || {
            let server = &servers[(number + attempts.next().unwrap()) % servers.len()];
            let sent_at = Instant::now();
            let answer = server.post_jpeg("/localize?map=m", frame(number, 0)).await;
            assert!(
                sent_at.elapsed() < Duration::from_secs(8),
                "an answer took {:?}",
                sent_at.elapsed()
            );
            if answer.status == 200 {
                return Ok(answer.expect(200));
            }
            assert!(answer.headers.contains_key("retry-after"));
            Err(answer.problem(503))
        })
        .await
    }

    #[tokio::test]
    #[ignore = "needs the scale-out deployment and a PostgreSQL that may be restarted"]
    async fn five_hundred_jobs_survive_the_death_of_processes_and_a_restart_of_the_database() {
        const JOBS: usize = 500;
        const KILLS: usize = 4;
        assert!(deployment::is_scale_out());
        let dir = TempDir::new().unwrap();
        let script = Script { latency: Duration::from_millis(20), ..Script::default() };
        let mock = MockMllm::start(script).await;
        let settings = settings(&mock);
        let mut servers = vec![serve(&dir, &settings), serve(&dir, &settings)];
        let mut workers: Vec<Server> = (0..3).map(|_| worker(&dir, &settings)).collect();
        servers[0].town("m", 10).await;

        let mut ids = HashSet::new();
        for number in 0..JOBS {
            match number {
                100 | 200 => {
                    workers.remove(0).kill();
                    workers.push(worker(&dir, &settings));
                }
                150 => {
                    // The other server still accepts frames.
                    servers.remove(0).kill();
                    localize(&servers, number + JOBS).await;
                    servers.push(serve(&dir, &settings));
                }
                250 => {
                    database("kill");
                    let down = servers[0].post_jpeg("/localize?map=m", frame(1, 0)).await;
                    assert!(down.problem(503).contains("database"), "{}", down.problem(503));
                    database("start");
                }
                350 => {
                    workers.remove(0).kill();
                    workers.push(worker(&dir, &settings));
                }
                _ => {}
            }
            let answer = localize(&servers, number).await;
            ids.insert(answer["job"]["id"].as_str().unwrap().to_owned());
        }
        assert_eq!(ids.len(), JOBS);
        for id in &ids {
            eventually_within(Duration::from_secs(180), async || {
                let job = servers[0].get(&format!("/jobs/{id}?wait=30")).await.expect(200);
                if job["finished_at"].is_null() { Err(job) } else { Ok(()) }
            })
            .await;
        }
        let jobs = ended(&servers[0], 2 * JOBS).await;
        let of = |state: &str| jobs.iter().filter(|job| job["state"] == state).count();
        assert_eq!(of("failed"), 0);
        // Jobs that were describing a pair when the database died.
        assert!(of("degraded") <= JOBS / 50, "{} jobs are degraded", of("degraded"));
        // A process that dies loses the answers it has not stored yet; one that lives pays for nothing twice.
        let again = mock.asked_again();
        eprintln!(
            "{JOBS} jobs by 2 servers and 3 workers, {KILLS} of them killed and the database once: {} \
             describe calls, {again} of them for pairs that had been answered",
            mock.describe_calls()
        );
        assert!(again <= (KILLS + 5) * CONCURRENCY, "{again} answered pairs were asked again");
        assert_eq!(mock.violations(), [""; 0]);
    }
}
