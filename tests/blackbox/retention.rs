//! Retention of ended jobs.

use serde_json::Value;
use tempfile::TempDir;
use walkdir::WalkDir;

use super::deployment;
use super::support::{Server, frame};
use super::wait::until;

fn files(dir: &TempDir) -> usize {
    let images = WalkDir::new(dir.path().join("images")).into_iter();
    images.filter(|entry| entry.as_ref().unwrap().file_type().is_file()).count()
}

/// All jobs, newest first, two on each page.
async fn listed(server: &Server) -> Vec<String> {
    let (mut ids, mut cursor) = (Vec::new(), String::new());
    loop {
        let page = server.get(&format!("/jobs?limit=2{cursor}")).await.expect(200);
        let jobs = page["jobs"].as_array().unwrap().iter();
        ids.extend(jobs.map(|job| job["id"].as_str().unwrap().to_owned()));
        match &page["next_cursor"] {
            Value::String(next) => cursor = format!("&cursor={next}"),
            _ => return ids,
        }
    }
}

#[tokio::test]
async fn ended_jobs_are_removed_with_their_frames_beyond_a_number() {
    let dir = TempDir::new().unwrap();
    let settings = [
        ("WHEREABOUTS_JOBS__KEEP_COUNT", "3"),
        ("WHEREABOUTS_JOBS__SWEEP_S", "1"),
        ("WHEREABOUTS_JOBS__SWEEP_BATCH", "2"),
        ("WHEREABOUTS_JOBS__MAX_WAIT_S", "20"),
    ];
    let server = Server::start(dir.path(), &settings);
    server.town("m", 4).await;
    let mut made = Vec::new();
    for variant in 0..8 {
        let path = "/localize?map=m&refine=wait";
        let answer = server.post_jpeg(path, frame(variant, variant as u32)).await.expect(200);
        made.push(answer["job"]["id"].as_str().unwrap().to_owned());
    }
    assert_eq!(listed(&server).await.len(), 8, "a client that waits still sees the end of its job");
    assert!(deployment::is_scale_out() || files(&dir) == 4 + 8);
    server.kill();

    let at_once = [settings[0], settings[1], settings[2], ("WHEREABOUTS_JOBS__MAX_WAIT_S", "0")];
    let server = Server::start(dir.path(), &at_once);
    // With a database, frames go later (objects.keep_unneeded_s).
    until(async || match deployment::is_scale_out() {
        true => listed(&server).await.len() <= 3,
        false => files(&dir) <= 4 + 3,
    })
    .await;
    made.reverse();
    assert_eq!(listed(&server).await, made[..3]);
    let why = server.get(&format!("/jobs/{}", made[5])).await.problem(404);
    assert!(why.contains("jobs.keep_count"), "{why}");
    server.get(&format!("/jobs/{}/events", made[5])).await.problem(404);
    let page = server.get(&format!("/jobs?cursor={}", made[4])).await.expect(200);
    assert_eq!(page["jobs"], Value::Array(vec![]));
    let metrics = server.metrics().await;
    let removed = "whereabouts_jobs_removed_total{why=\"count\"} 5";
    assert!(metrics.contains(removed), "{metrics}");
    assert!(server.log().contains("ended jobs were removed"));
}
