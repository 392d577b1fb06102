//! `/jobs`.

use serde_json::{Value, json};

use super::support::{Server, frame, server, shared_server};
use tempfile::TempDir;

async fn localize(server: &Server, map: &str, place: usize) -> Value {
    server.post_jpeg(&format!("/localize?map={map}"), frame(place, 0)).await.expect(200)
}

#[tokio::test]
async fn a_job_describes_every_pair_and_ranks_every_candidate_once() {
    let (server, map) = shared_server();
    server.town(&map, 15).await;
    let answer = localize(server, &map, 3).await;
    let href = answer["job"]["href"].as_str().unwrap();
    let job = server.get(&format!("{href}?wait=30")).await.expect(200);
    assert_eq!(job["state"], "succeeded", "{job}");
    assert_eq!(job["refiner"], "local");
    assert_eq!(job["query_id"], answer["query_id"]);
    assert_eq!(job["attempts"], 1);
    assert_eq!(job["error"], json!(null));
    let ids = |list: &Value| -> Vec<String> {
        let of = |item: &Value| item["image_id"].as_str().unwrap().to_owned();
        list.as_array().unwrap().iter().map(of).collect()
    };
    // The job compares all fifteen candidates, of which the response lists ten.
    let compared =
        server.post_jpeg(&format!("/localize?map={map}&k=15&refine=off"), frame(3, 0)).await;
    let candidates = ids(&compared.expect(200)["candidates"]);
    assert_eq!(ids(&answer["candidates"]), candidates[..10]);
    assert_eq!(ids(&job["descriptions"]), candidates);
    let mut ranked = ids(&job["ranking"]);
    for (position, place) in job["ranking"].as_array().unwrap().iter().enumerate() {
        assert_eq!(place["rank"], position + 1);
        let coarse = place["coarse_rank"].as_u64().unwrap() as usize;
        assert_eq!(place["image_id"], candidates[coarse - 1]);
        assert!(place["pose"]["lat"].is_f64());
    }
    ranked.sort();
    let mut all = candidates.clone();
    all.sort();
    assert_eq!(ranked, all);
    for description in job["descriptions"].as_array().unwrap() {
        assert!(description["text"].as_str().unwrap().len() > 40, "{description}");
        assert!(description["took_ms"].is_u64(), "{description}");
    }
    assert!(job["reasoning"].is_string() && job["reasoning_took_ms"].is_null());
    assert!(job["created_at"].as_str() <= job["finished_at"].as_str());
}

#[tokio::test]
async fn jobs_are_listed_newest_first_by_map_and_state() {
    let (server, map) = shared_server();
    server.town(&map, 3).await;
    server.town(&format!("{map}-other"), 2).await;
    let mut made = Vec::new();
    for place in 0..3 {
        let answer = localize(server, &map, place).await;
        server
            .get(&format!("{}?wait=30", answer["job"]["href"].as_str().unwrap()))
            .await
            .expect(200);
        made.push(answer["job"]["id"].clone());
    }
    server.post_jpeg(&format!("/localize?map={map}-other"), frame(0, 0)).await.expect(200);
    made.reverse();
    let ids = |page: &Value| -> Vec<Value> {
        page["jobs"].as_array().unwrap().iter().map(|job| job["id"].clone()).collect()
    };
    let page = server.get(&format!("/jobs?map={map}&state=succeeded&limit=2")).await.expect(200);
    assert_eq!(ids(&page), made[..2]);
    let cursor = page["next_cursor"].as_str().unwrap();
    let rest = server.get(&format!("/jobs?map={map}&limit=2&cursor={cursor}")).await.expect(200);
    assert_eq!((ids(&rest), &rest["next_cursor"]), (made[2..].to_vec(), &json!(null)));
    let failed = server.get(&format!("/jobs?map={map}&state=failed")).await.expect(200);
    assert_eq!(ids(&failed), [] as [Value; 0]);
}

#[tokio::test]
async fn jobs_are_searched_for_a_text_ignoring_case() {
    let (_dir, server) = server();
    server.town("m", 3).await;
    server.town("backyard", 1).await;
    let mut made = Vec::new();
    for map in ["m", "backyard", "m"] {
        let path = format!("/localize?map={map}&refine=wait");
        let answer = server.post_jpeg(&path, frame(made.len(), 0)).await.expect(200);
        made.push(answer);
    }
    let id = |at: usize| made[at]["job"]["id"].as_str().unwrap().to_owned();
    let search = async |query: String| -> Vec<String> {
        let page = server.get(&format!("/jobs?{query}")).await.expect(200);
        assert_eq!(page["next_cursor"], json!(null));
        let jobs = page["jobs"].as_array().unwrap().iter();
        jobs.map(|job| job["id"].as_str().unwrap().to_owned()).collect()
    };
    let query_id = made[1]["query_id"].as_str().unwrap().to_uppercase();
    assert_eq!(search(format!("q={query_id}")).await, [id(1)]);
    assert_eq!(search(format!("q={}", &id(0)[24..])).await, [id(0)]);
    assert_eq!(search("q=BACKYARD".into()).await, [id(1)]);
    let only_in_m = made[0]["candidates"].as_array().unwrap().iter();
    let first = made[1]["candidates"][0]["image_id"].as_str().unwrap();
    let another = only_in_m.map(|one| one["image_id"].as_str().unwrap()).find(|of| *of != first);
    let another = another.unwrap().to_uppercase();
    assert_eq!(search(format!("q={another}")).await, [id(2), id(0)]);
    // Words of a description, combined with the other filters.
    assert_eq!(search("q=Regions+Of+The&brief=true".into()).await, [id(2), id(1), id(0)]);
    assert_eq!(search("q=regions+of+the&map=backyard&state=succeeded".into()).await, [id(1)]);
    assert_eq!(search("q=regions+of+the&state=failed".into()).await, [""; 0]);
    assert_eq!(search("q=no+job+says+so".into()).await, [""; 0]);
    assert_eq!(search("q=++".into()).await.len(), 3);
    let page = server.get(&format!("/jobs?q={another}&limit=1")).await.expect(200);
    let cursor = page["next_cursor"].as_str().unwrap();
    assert_eq!(search(format!("q={another}&limit=1&cursor={cursor}")).await, [id(0)]);
    server.get(&format!("/jobs?q={}", "%C3%A9".repeat(200))).await.expect(200);
    let why = server.get(&format!("/jobs?q={}", "a".repeat(201))).await.problem(400);
    assert!(why.contains("200"), "{why}");
}

#[tokio::test]
async fn a_full_job_queue_answers_without_a_job_or_429_to_a_client_that_waits_for_one() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    server.town("m", 3).await;
    assert!(server.terminate().success());
    let server = Server::start(dir.path(), &[("WHEREABOUTS_JOBS__QUEUE", "1")]);
    let frames: Vec<_> = (0..8).map(|variant| frame(0, variant)).collect();
    let posts = frames.into_iter().map(|frame| server.post_jpeg("/localize?map=m", frame));
    let answers = futures_util::future::join_all(posts).await;
    let answers: Vec<Value> = answers.iter().map(|answer| answer.expect(200)).collect();
    assert!(answers.iter().any(|answer| answer["job"]["id"].is_string()));
    let without = answers.iter().find(|answer| answer["job"].is_null());
    let without = without.expect("the queue never filled");
    assert_eq!(without["no_job"]["reason"], "queue_full");
    assert!(!without["candidates"].as_array().unwrap().is_empty());
    let posts = (0..8).map(|variant| frame(1, variant));
    let posts = posts.map(|frame| server.post_jpeg("/localize?map=m&refine=wait", frame));
    let answers = futures_util::future::join_all(posts).await;
    let full = answers.iter().find(|answer| answer.status == 429).expect("the queue never filled");
    assert!(full.problem(429).contains("refine=off"));
    assert!(full.headers.contains_key("retry-after"));
    server.post_jpeg("/localize?map=m&refine=off", frame(0, 0)).await.expect(200);
}

#[tokio::test]
async fn a_job_whose_map_was_deleted_ends_with_the_reason() {
    let (server, map) = shared_server();
    server.town(&map, 3).await;
    let jobs: Vec<Value> =
        [localize(server, &map, 0).await, localize(server, &map, 1).await].into();
    server.delete(&format!("/maps/{map}")).await.expect(204);
    for answer in jobs {
        let href = answer["job"]["href"].as_str().unwrap();
        let job = server.get(&format!("{href}?wait=30")).await.expect(200);
        let state = job["state"].as_str().unwrap();
        assert!(matches!(state, "succeeded" | "degraded" | "failed"), "{job}");
        assert_eq!(state == "succeeded", job["error"].is_null(), "{job}");
    }
}

#[tokio::test]
async fn an_answer_that_waited_has_the_refined_order_and_any_other_has_none() {
    let (server, map) = shared_server();
    server.town(&map, 3).await;
    for mode in ["wait", "async", "off"] {
        let path = format!("/localize?map={map}&refine={mode}");
        let answer = server.post_jpeg(&path, frame(0, 0)).await.expect(200);
        if mode == "wait" {
            let job = server.get(answer["job"]["href"].as_str().unwrap()).await.expect(200);
            assert_eq!(answer["ranking"].as_array().unwrap().len(), 3);
            assert_eq!(answer["ranking"], job["ranking"]);
            assert_eq!(answer["estimate"]["image_id"], answer["ranking"][0]["image_id"]);
        } else {
            assert!(answer["ranking"].is_null(), "{mode}: {answer}");
        }
    }
}

#[tokio::test]
async fn an_ended_job_is_not_cancelled_and_a_succeeded_one_is_not_retried() {
    let (server, map) = shared_server();
    server.town(&map, 2).await;
    let answer = server
        .post_jpeg(&format!("/localize?map={map}&refine=wait"), frame(0, 0))
        .await
        .expect(200);
    let href = answer["job"]["href"].as_str().unwrap();
    let cancelled = server.post(&format!("{href}/cancel"), "text/plain", vec![]).await.expect(200);
    assert_eq!(cancelled["state"], "succeeded");
    server.post(&format!("{href}/retry"), "text/plain", vec![]).await.problem(409);
}

#[tokio::test]
async fn an_unknown_job_id_is_404() {
    let (server, _) = shared_server();
    server.get("/jobs/not-a-uuid").await.problem(400);
    let unknown = "/jobs/01900000-0000-7000-8000-000000000000";
    server.get(unknown).await.problem(404);
    server.get(&format!("{unknown}?wait=5")).await.problem(404);
    server.get(&format!("{unknown}?wait=1e9")).await.problem(422);
    server.get(&format!("{unknown}?wait=-1")).await.problem(422);
}
