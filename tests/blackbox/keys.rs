//! API keys: authentication, roles, scopes, rate limits, and secrecy.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use reqwest::Method;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::deployment;
use super::support::{Answer, BINARY, Server, frame, reference, shared_server};
use super::wait::eventually_within;

const REQUIRED: [(&str, &str); 2] =
    [("WHEREABOUTS_AUTH__KEYS", "required"), ("WHEREABOUTS_LOG__FILTER", "debug")];

/// Creates a key in the data folder of a server that is not running.
fn create(data: &Path, args: &[&str]) -> String {
    let output = Command::new(&*BINARY)
        .args(["keys", "create", "--name", "test", "--data"])
        .arg(data)
        .args(args)
        .envs(deployment::settings(data))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

/// Sends a request with a key.
async fn ask(
    server: &Server,
    key: &str,
    method: Method,
    path: &str,
    body: Option<Value>,
) -> Answer {
    let request = server.request(method, path).bearer_auth(key);
    Answer::of(match body {
        Some(body) => request.json(&body),
        None => request,
    })
    .await
}

pub async fn get(server: &Server, key: &str, path: &str) -> Answer {
    ask(server, key, Method::GET, path, None).await
}

async fn post_jpeg(server: &Server, key: &str, path: &str, picture: Vec<u8>) -> Answer {
    let request = server.request(Method::POST, path).header("content-type", "image/jpeg");
    Answer::of(request.bearer_auth(key).body(picture)).await
}

/// A server with two maps of two images and a key for each role; that of the robot is limited to the first map.
pub struct Guarded {
    pub dir: TempDir,
    pub server: Server,
    pub admin: String,
    operator: String,
    robot: String,
}

impl Guarded {
    pub async fn start() -> Self {
        let dir = TempDir::new().unwrap();
        let admin = create(dir.path(), &["--role", "admin"]);
        let operator = create(dir.path(), &["--role", "operator"]);
        let robot =
            create(dir.path(), &["--role", "robot", "--map", "yard", "--expires-days", "2"]);
        let server = Server::start(dir.path(), &REQUIRED);
        let guarded = Self { dir, server, admin, operator, robot };
        for map in ["yard", "vault"] {
            let scene = Some(json!({"scene": "outdoor"}));
            let path = format!("/maps/{map}");
            ask(&guarded.server, &guarded.admin, Method::PUT, &path, scene).await.expect(201);
            for place in 0..2 {
                let path = format!("/maps/{map}/images?id=p{place}");
                post_jpeg(&guarded.server, &guarded.operator, &path, reference(place))
                    .await
                    .expect(201);
            }
        }
        guarded
    }
}

#[tokio::test]
async fn a_server_that_requires_keys_and_has_none_does_not_start() {
    let dir = TempDir::new().unwrap();
    let log = Server::try_start(dir.path(), &REQUIRED).err().unwrap();
    assert!(log.contains("keys create") && log.contains("--no-keys"), "{log}");
    let everywhere = [("WHEREABOUTS_SERVER__LISTEN", "0.0.0.0:0")];
    let start = |flags: &[&str]| {
        let mut command = Command::new("timeout");
        command.arg("6").arg(&*BINARY).args(["serve", "--data"]).arg(dir.path()).args(flags);
        command.env("WHEREABOUTS_MODEL__NAME", "xfeat").envs(everywhere);
        let output = command.output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let (code, log) = start(&[]);
    assert_eq!(code, Some(1));
    assert!(log.contains("keys create"), "{log}");
    let (_, log) = start(&["--no-keys"]);
    assert!(log.contains("NO KEYS") && log.contains("ready"), "{log}");
}

#[tokio::test]
async fn a_request_without_a_valid_key_is_401() {
    let Guarded { server, robot, .. } = &Guarded::start().await;
    for path in ["/livez", "/readyz", "/docs", "/openapi.json"] {
        assert_eq!(server.get(path).await.status, 200, "{path}");
    }
    let calls = [
        (Method::GET, "/maps"),
        (Method::GET, "/maps/yard/images"),
        (Method::POST, "/localize?map=yard"),
        (Method::GET, "/jobs"),
        (Method::GET, "/keys"),
        (Method::GET, "/metrics"),
        (Method::DELETE, "/maps/yard"),
        (Method::PATCH, "/maps/yard"),
    ];
    for (method, path) in &calls {
        let answer = Answer::of(server.request(method.clone(), path)).await;
        let problem = answer.problem(401);
        assert!(problem.contains("keys create"), "{method} {path}: {problem}");
        assert_eq!(answer.headers["www-authenticate"], "Bearer realm=\"whereabouts\"");
    }
    let mut wrong = robot.clone();
    wrong.replace_range(80.., if robot.ends_with('0') { "1" } else { "0" });
    let no_such = format!("wab_{}_{}", "0".repeat(12), "0".repeat(64));
    let long = "x".repeat(5000);
    for key in ["", "x", &wrong, &no_such, &robot[..80], &robot.to_uppercase(), &long] {
        let problem = get(server, key, "/maps").await.problem(401);
        assert!(!problem.contains(&robot[17..40]), "{problem}");
    }
    for header in [robot.clone(), format!("Basic {robot}"), format!("Bearer  {robot} x")] {
        let request = server.request(Method::GET, "/maps").header("authorization", header);
        Answer::of(request).await.problem(401);
    }
    let twice = server.request(Method::GET, "/maps").bearer_auth(robot).bearer_auth(robot);
    Answer::of(twice).await.problem(401);
    // A key in the URL is not accepted, because URLs are logged.
    server.get(&format!("/maps?key={robot}")).await.problem(401);
    get(server, robot, "/maps").await.expect(200);
}

#[tokio::test]
async fn each_role_has_its_permissions() {
    let Guarded { dir, server, admin, operator, robot } = Guarded::start().await;
    let localized = post_jpeg(&server, &robot, "/localize?map=yard", frame(0, 0)).await.expect(200);
    let job = localized["job"]["href"].as_str().unwrap().to_owned();
    assert_eq!(get(&server, &robot, &format!("{job}?wait=60")).await.expect(200)["map"], "yard");

    let is = |answer: Answer, allowed: bool, what: String| match allowed {
        true => assert!(answer.status.as_u16() < 400, "{what}: {}", answer.status),
        false => assert!(answer.problem(403).contains("role"), "{what}"),
    };
    for (method, path, operators) in [
        (Method::GET, "/jobs".to_owned(), true),
        (Method::GET, "/usage".to_owned(), true),
        (Method::GET, "/metrics".to_owned(), true),
        (Method::GET, "/maps/yard/images".to_owned(), true),
        (Method::GET, "/maps/yard/images/p0/content".to_owned(), true),
        (Method::POST, format!("{job}/cancel"), true),
        (Method::GET, "/keys".to_owned(), false),
        (Method::GET, "/maps/yard/export".to_owned(), false),
    ] {
        let what = format!("{method} {path}");
        is(ask(&server, &robot, method.clone(), &path, None).await, false, what.clone());
        is(ask(&server, &operator, method.clone(), &path, None).await, operators, what.clone());
        is(ask(&server, &admin, method, &path, None).await, true, what);
    }
    let scene = Some(json!({"scene": "indoor"}));
    for key in [&robot, &operator] {
        ask(&server, key, Method::PUT, "/maps/new", scene.clone()).await.problem(403);
        ask(&server, key, Method::DELETE, "/maps/yard", None).await.problem(403);
        let made = json!({"name": "more", "role": "admin"});
        ask(&server, key, Method::POST, "/keys", Some(made)).await.problem(403);
    }
    // The audit log names the key by its id; no log contains a token.
    ask(&server, &admin, Method::DELETE, "/maps/vault", None).await.expect(204);
    let log = server.log();
    let audited = log.lines().find(|line| line.contains("\"audit\"") && line.contains("vault"));
    let audited: Value = serde_json::from_str(audited.expect("no line of the audit log")).unwrap();
    assert!(admin.contains(audited["key"].as_str().unwrap()), "{audited}");
    for key in [&admin, &operator, &robot] {
        assert!(!log.contains(&key[17..]), "a key is in the log");
    }
    server.kill();
    // With a database there is no data folder to search.
    if !deployment::is_scale_out() {
        let stored = std::fs::read(dir.path().join("db/db")).unwrap();
        for key in [&admin, &operator, &robot] {
            let secret = &key.as_bytes()[17..];
            let found = stored.windows(secret.len()).any(|window| window == secret);
            assert!(!found, "a key is on the disk");
        }
    }
}

#[tokio::test]
async fn a_key_for_one_map_grants_no_access_to_another() {
    let Guarded { server, robot, operator, admin, .. } = &Guarded::start().await;
    let listed = get(server, robot, "/maps").await.expect(200);
    assert_eq!(listed["maps"].as_array().unwrap().len(), 1);
    assert_eq!(
        get(server, operator, "/maps").await.expect(200)["maps"].as_array().unwrap().len(),
        2
    );
    let elsewhere = post_jpeg(server, operator, "/localize?map=vault", frame(0, 0)).await;
    let job = elsewhere.expect(200)["job"]["href"].as_str().unwrap().to_owned();
    for path in [
        "/maps/vault".to_owned(),
        "/maps/%76ault".to_owned(),
        job.clone(),
        format!("{job}/events"),
        format!("{job}?map=yard"),
    ] {
        let answer = get(server, robot, &path).await;
        assert!(answer.problem(403).contains("map"), "{path}");
    }
    for query in ["map=vault", "map=%76ault", "map=vault&k=1", "k=1", "map=yard&map=vault", ""] {
        let path = format!("/localize?{query}");
        post_jpeg(server, robot, &path, frame(0, 0)).await.problem(403);
    }
    // Malformed paths reach no map.
    for path in [
        "/maps/yard/../vault",
        "/maps/yard%2f..%2fvault",
        "/maps/..%2fvault",
        "/maps/yard%00",
        "/maps//vault",
        "/maps/vault%20",
    ] {
        let answer = get(server, robot, path).await;
        assert!((400..=404).contains(&answer.status.as_u16()), "{path}: {}", answer.status);
        assert!(!String::from_utf8_lossy(&answer.bytes).contains("created_at"), "{path}");
    }

    let made = json!({"name": "m", "role": "operator", "maps": ["vault"]});
    let made = ask(server, admin, Method::POST, "/keys", Some(made)).await.expect(201);
    let vault = made["token"].as_str().unwrap();
    get(server, vault, "/jobs?map=vault").await.expect(200);
    get(server, vault, "/jobs?map=yard").await.problem(403);
    assert!(get(server, vault, "/jobs").await.problem(403).contains("?map="));
    get(server, vault, "/maps/yard/images").await.problem(403);
}

#[tokio::test]
async fn a_revoked_key_is_rejected_at_once_and_after_a_kill() {
    let Guarded { dir, server, admin, robot, .. } = Guarded::start().await;
    let id = &robot[4..16];
    get(&server, &robot, "/maps").await.expect(200);
    let revoked = ask(&server, &admin, Method::DELETE, &format!("/keys/{id}"), None).await;
    assert!(revoked.expect(200)["revoked_at"].is_string());
    assert!(get(&server, &robot, "/maps").await.problem(401).contains("revoked"));
    let listed = get(&server, &admin, "/keys").await;
    assert!(!String::from_utf8_lossy(&listed.bytes).contains("digest"));
    server.kill();
    let server = Server::start(dir.path(), &REQUIRED);
    get(&server, &robot, "/maps").await.problem(401);
    get(&server, &admin, "/maps").await.expect(200);
    ask(&server, &admin, Method::DELETE, "/keys/000000000000", None).await.problem(404);
    for wrong in [
        json!({"name": "", "role": "robot"}),
        json!({"name": "n", "role": "robot", "expires_days": 0}),
        json!({"name": "n", "role": "robot", "limits": {"requests_per_minute": 0}}),
    ] {
        ask(&server, &admin, Method::POST, "/keys", Some(wrong)).await.problem(422);
    }
    for wrong in [json!({"name": "n", "role": "king"}), json!({"name": "n"}), json!([])] {
        ask(&server, &admin, Method::POST, "/keys", Some(wrong)).await.problem(400);
    }
}

#[tokio::test]
async fn a_revocation_is_completed_and_audited_though_the_client_hangs_up() {
    let Guarded { dir: _dir, server, admin, .. } = Guarded::start().await;
    let mut keys = Vec::new();
    for number in 0..20 {
        let new_key = json!({"name": format!("key {number}"), "role": "robot"});
        let made = ask(&server, &admin, Method::POST, "/keys", Some(new_key)).await.expect(201);
        keys.push(made["token"].as_str().unwrap().to_owned());
    }
    for (number, key) in keys.iter().enumerate() {
        let revoke = server.request(Method::DELETE, &format!("/keys/{}", &key[4..16]));
        let timeout = Duration::from_micros(500 + 200 * number as u64);
        let _ = revoke.bearer_auth(&admin).timeout(timeout).send().await;
    }
    // Some were given up before the server had received them; each of the others is finished.
    eventually_within(Duration::from_secs(20), async || {
        let mut refused = Vec::new();
        for key in &keys {
            refused.push(get(&server, key, "/maps").await.status == 401);
        }
        let log = server.log();
        for (key, refused) in keys.iter().zip(refused) {
            let id = &key[4..16];
            let revoked = log.lines().any(|line| line.contains("was revoked") && line.contains(id));
            let audited = log.lines().any(|line| line.contains(&format!("/keys/{id}")));
            if refused != revoked || revoked && !audited {
                return Err(format!(
                    "key {id}: refused {refused}, revoked {revoked}, audited {audited}"
                ));
            }
        }
        if log.contains("was revoked") { Ok(()) } else { Err(log) }
    })
    .await;
}

#[tokio::test]
async fn an_event_stream_ends_with_its_key_and_a_track_belongs_to_a_key() {
    let Guarded { dir: _dir, server, admin, operator, robot } = Guarded::start().await;
    let stream = server.request(Method::GET, "/events").bearer_auth(&operator);
    let stream = stream.send().await.unwrap();
    assert_eq!(stream.status(), 200);
    let path = format!("/keys/{}", &operator[4..16]);
    ask(&server, &admin, Method::DELETE, &path, None).await.expect(200);
    let rest = tokio::time::timeout(Duration::from_secs(5), stream.bytes()).await;
    assert_eq!(rest.expect("the stream goes on").unwrap(), ": open\n\n");

    let scene = Some(json!({"scene": "outdoor", "frame": "metric"}));
    ask(&server, &admin, Method::PUT, "/maps/lane", scene).await.expect(201);
    for place in 0..2 {
        let path = format!("/maps/lane/images?id=p{place}&x={place}&y=0");
        post_jpeg(&server, &admin, &path, reference(place)).await.expect(201);
    }
    let made = json!({"name": "r", "role": "robot"});
    let made = ask(&server, &admin, Method::POST, "/keys", Some(made)).await.expect(201);
    let path = "/localize?map=lane&refine=off&track=one";
    for (key, frames) in
        [(admin.as_str(), 1), (admin.as_str(), 2), (made["token"].as_str().unwrap(), 1)]
    {
        let answer = post_jpeg(&server, key, path, frame(0, 0)).await.expect(200);
        assert_eq!(answer["track"]["frames"], frames);
    }
    post_jpeg(&server, &robot, path, frame(0, 0)).await.problem(403);
}

#[tokio::test]
async fn a_key_has_rate_limits_and_responses_report_the_rest() {
    let dir = TempDir::new().unwrap();
    let few = create(dir.path(), &["--role", "robot", "--requests-per-minute", "3"]);
    let small = create(dir.path(), &["--role", "admin", "--bytes-per-minute", "20000"]);
    let server = Server::start(dir.path(), &REQUIRED);
    for left in ["2", "1", "0"] {
        let answer = get(&server, &few, "/maps").await;
        answer.expect(200);
        assert_eq!(answer.headers["ratelimit-policy"], "\"requests\";q=3;w=60");
        let rest = answer.headers["ratelimit"].to_str().unwrap();
        assert!(rest.starts_with(&format!("\"requests\";r={left};t=")), "{rest}");
    }
    let refused = get(&server, &few, "/maps").await;
    assert!(refused.problem(429).contains("3 requests per minute"));
    let pause: u64 = refused.headers["retry-after"].to_str().unwrap().parse().unwrap();
    assert!((1..=20).contains(&pause), "{pause}");
    assert!(refused.headers.contains_key("ratelimit"));

    let scene = Some(json!({"scene": "outdoor"}));
    let made = ask(&server, &small, Method::PUT, "/maps/m", scene).await;
    made.expect(201);
    assert!(made.headers["ratelimit-policy"].to_str().unwrap().contains("content-bytes"));
    post_jpeg(&server, &small, "/maps/m/images?id=a", reference(0)).await.expect(201);
    post_jpeg(&server, &small, "/maps/m/images?id=b", reference(1)).await;
    let refused = post_jpeg(&server, &small, "/maps/m/images?id=c", reference(2)).await;
    assert!(refused.problem(429).contains("20000 bytes per minute"));
}

#[tokio::test]
async fn no_cross_origin_request_is_allowed() {
    let (server, _) = shared_server();
    for method in [Method::OPTIONS, Method::GET, Method::DELETE] {
        let request =
            server.request(method.clone(), "/maps/yard").header("origin", "https://other.example");
        let request = request.header("access-control-request-method", "DELETE");
        let answer =
            Answer::of(request.header("access-control-request-headers", "authorization")).await;
        let allowed =
            answer.headers.keys().find(|name| name.as_str().starts_with("access-control-"));
        assert_eq!(allowed, None, "{method}");
    }
}
