//! The calls of the operator console, and how its files are served.

use reqwest::header::{CONTENT_SECURITY_POLICY, ETAG, IF_NONE_MATCH};
use reqwest::{Method, StatusCode};

use super::deployment;
use super::support::{Answer, Server, frame, shared_server};

#[tokio::test]
async fn the_console_has_a_content_security_policy_and_is_cached_by_its_etag() {
    let (server, _) = shared_server();
    for (path, kind) in
        [("/", "text/html; charset=utf-8"), ("/console/app.js", "text/javascript; charset=utf-8")]
    {
        let page = server.get(path).await;
        assert_eq!(
            (page.status, &page.headers["content-type"]),
            (StatusCode::OK, &kind.parse().unwrap())
        );
        let policy = page.headers[CONTENT_SECURITY_POLICY].to_str().unwrap();
        assert!(policy.contains("default-src 'none'") && !policy.contains("unsafe"), "{policy}");
        let tag = &page.headers[ETAG];
        let again = server.request(Method::GET, path).header(IF_NONE_MATCH, tag);
        let again = Answer::of(again).await;
        assert_eq!((again.status, again.bytes.len()), (StatusCode::NOT_MODIFIED, 0));
    }
    assert_eq!(server.get("/console/nothing.js").await.status, StatusCode::NOT_FOUND);
    assert_eq!(server.get("/console/..%2fmod.rs").await.status, StatusCode::NOT_FOUND);
}

#[tokio::test]
async fn jobs_can_be_listed_without_descriptions_and_ranking() {
    let (server, map) = shared_server();
    server.town(&map, 3).await;
    server.post_jpeg(&format!("/localize?map={map}&refine=wait"), frame(0, 0)).await.expect(200);
    let whole = server.get(&format!("/jobs?map={map}")).await.expect(200)["jobs"][0].clone();
    let mut brief =
        server.get(&format!("/jobs?map={map}&brief=true")).await.expect(200)["jobs"][0].clone();
    assert_eq!(brief["descriptions"], serde_json::json!([]));
    assert!(brief["ranking"].is_null() && brief["reasoning"].is_null());
    for field in ["descriptions", "ranking", "reasoning"] {
        assert_ne!(brief[field], whole[field]);
        brief[field] = whole[field].clone();
    }
    assert_eq!(brief, whole);
}

#[tokio::test]
async fn map_tiles_come_only_from_the_configured_server() {
    let dir = tempfile::tempdir().unwrap();
    let url = "https://tiles.example/{z}/{x}/{y}.png";
    let server = Server::start(dir.path(), &[("WHEREABOUTS_CONSOLE__TILES_URL", url)]);
    let policy =
        server.get("/").await.headers[CONTENT_SECURITY_POLICY].to_str().unwrap().to_owned();
    assert!(policy.contains("img-src 'self' blob: https://tiles.example;"), "{policy}");
    assert_eq!(server.get("/status").await.expect(200)["tiles"]["url"], url);
    drop(server);
    for wrong in [
        "https://tiles.example/{z}/{x}.png",
        "https://a; script-src *{z}{x}{y}",
        "javascript:{z}{x}{y}",
    ] {
        let settings = [("WHEREABOUTS_CONSOLE__TILES_URL", wrong)];
        let refused = Server::try_start(dir.path(), &settings).err().unwrap();
        assert!(refused.contains("console.tiles_url"), "{refused}");
    }
}

#[tokio::test]
async fn a_job_shows_its_frame_and_the_regions_that_match_a_candidate() {
    let (server, map) = shared_server();
    server.town(&map, 4).await;
    let sent = frame(1, 0);
    let answer = server
        .post_jpeg(&format!("/localize?map={map}&refine=wait"), sent.clone())
        .await
        .expect(200);
    let job = answer["job"]["id"].as_str().unwrap();
    let shown = server.get(&format!("/jobs/{job}/frame")).await;
    assert_eq!((shown.status, shown.bytes), (StatusCode::OK, sent));
    let small = server.get(&format!("/jobs/{job}/frame?max_edge=64")).await;
    let small = image::load_from_memory(&small.bytes).unwrap();
    assert_eq!(small.width().max(small.height()), 64);
    server.get(&format!("/jobs/{job}/frame?max_edge=1")).await.problem(422);

    let first = answer["estimate"]["image_id"].as_str().unwrap();
    let matches = server.get(&format!("/jobs/{job}/matches/{first}")).await.expect(200);
    let regions = matches["regions"].as_array().unwrap();
    let job_now = server.get(&format!("/jobs/{job}")).await.expect(200);
    let text = &job_now["descriptions"].as_array().unwrap().iter();
    let text =
        text.clone().find(|pair| pair["image_id"] == first).unwrap()["text"].as_str().unwrap();
    assert!(text.contains(&regions.len().to_string()), "{} regions, and {text}", regions.len());
    for region in regions {
        for place in [&region["frame"], &region["image"]] {
            let inside = |value: &serde_json::Value| (0.0..=1.0).contains(&value.as_f64().unwrap());
            assert!(place.as_array().unwrap().iter().all(inside), "{region}");
        }
    }
    server.get(&format!("/jobs/{job}/matches/nothing")).await.problem(404);
    let unknown = uuid::Uuid::nil();
    server.get(&format!("/jobs/{unknown}/frame")).await.problem(404);
    server.get(&format!("/jobs/{unknown}/matches/{first}")).await.problem(404);
    server.delete(&format!("/maps/{map}")).await;
    server.get(&format!("/jobs/{job}/matches/{first}")).await.problem(404);
}

#[tokio::test]
async fn the_status_covers_the_last_hour_and_hides_secrets() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start(dir.path(), &[("WHEREABOUTS_MLLM__API_KEY", "sk-very-secret")]);
    server.town("m", 2).await;
    for _ in 0..3 {
        server.post_jpeg("/localize?map=m&refine=wait", frame(0, 0)).await.expect(200);
    }
    let status = server.get("/status").await.expect(200);
    let minutes = status["minutes"].as_array().unwrap();
    let sum =
        |field: &str| minutes.iter().map(|minute| minute[field].as_u64().unwrap()).sum::<u64>();
    assert_eq!((sum("frames"), sum("jobs_ended"), sum("jobs_failed")), (3, 3, 0));
    assert!(minutes.iter().any(|minute| minute["p95_ms"].as_f64().is_some_and(|ms| ms > 0.0)));
    assert_eq!(
        (status["refiner"].as_str(), status["keys_required"].as_bool()),
        (Some("local"), Some(false))
    );
    assert_eq!(status["models"][0]["name"], "xfeat");
    // An object store does not report its free space.
    assert!(deployment::is_scale_out() || status["free_bytes"].as_u64().unwrap() > 0);
    assert!(status["db_bytes"].as_u64().unwrap() > 0);
    let settings = status["settings"].as_str().unwrap();
    assert!(settings.contains("[server]") && !settings.contains("very-secret"), "{settings}");
}
