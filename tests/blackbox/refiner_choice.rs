//! Which refiner refines a job, and what a job of `cascade` shows.

use serde_json::{Value, json};
use tempfile::TempDir;

use super::mllm::start;
use super::mock_mllm::{MockMllm, Reply, Script};
use super::support::{Server, frame, reference};

/// The job of a frame, localized with these parameters.
async fn job(server: &Server, parameters: &str) -> Value {
    let path = format!("/localize?map=m&refine=wait{parameters}");
    let answer = server.post_jpeg(&path, frame(3, 0)).await.expect(200);
    server.get(answer["job"]["href"].as_str().unwrap()).await.expect(200)
}

fn calls(mock: &MockMllm) -> usize {
    mock.describe_calls() + mock.reason_calls()
}

#[tokio::test]
async fn a_request_chooses_a_refiner_that_is_allowed_and_costs_no_more_than_the_maps() {
    let dir = TempDir::new().unwrap();
    let mock = MockMllm::start(Script::default()).await;
    let allowed =
        [("WHEREABOUTS_REFINE__REFINER", "local"), ("WHEREABOUTS_REFINE__ALLOWED", r#"["mllm"]"#)];
    let server = start(&dir, &mock, &allowed);
    server.town("m", 4).await;
    assert_eq!(job(&server, "").await["refiner"], "local");
    assert_eq!(calls(&mock), 0);
    let chosen = job(&server, "&refiner=mllm").await;
    assert_eq!((&chosen["refiner"], &chosen["usage"]["calls"]), (&json!("mllm"), &json!(5)));
    let refused = server.post_jpeg("/localize?map=m&refiner=cascade", frame(3, 0)).await;
    assert!(refused.problem(403).contains("allowed: local, mllm"));
    let refused = server.post_jpeg("/localize?map=m&refine=off&refiner=local", frame(3, 0)).await;
    assert!(refused.problem(400).contains("refine=off"));
    let unknown = server.post_jpeg("/localize?map=m&refiner=oracle", frame(3, 0)).await;
    unknown.problem(400);

    let state = server.put("/maps/m", json!({"refiner": "mllm"})).await.expect(200);
    assert_eq!(state["refiner"], "mllm");
    assert_eq!(job(&server, "").await["refiner"], "mllm");
    assert_eq!(job(&server, "&refiner=local").await["refiner"], "local");
    server.put("/maps/m", json!({"refiner": "local"})).await.expect(200);
    let before = calls(&mock);
    let refused = server.post_jpeg("/localize?map=m&refiner=mllm", frame(3, 0)).await;
    assert!(refused.problem(403).contains("which the map m is set to"));
    assert_eq!(calls(&mock), before);
    // Other changes leave it as it is.
    let state = server.put("/maps/m", json!({"scene": "indoor"})).await.expect(200);
    assert_eq!(state["refiner"], "local");
    let state = server.put("/maps/m", json!({"refiner": "default"})).await.expect(200);
    assert_eq!(state["refiner"], Value::Null);
}

#[tokio::test]
async fn no_client_spends_money_where_only_local_is_allowed() {
    let dir = TempDir::new().unwrap();
    let mock = MockMllm::start(Script::default()).await;
    let server = start(&dir, &mock, &[("WHEREABOUTS_REFINE__REFINER", "local")]);
    server.town("m", 2).await;
    for paid in ["mllm", "cascade"] {
        let refused =
            server.post_jpeg(&format!("/localize?map=m&refiner={paid}"), frame(1, 0)).await;
        assert!(refused.problem(403).contains("allowed: local"));
        server.put("/maps/m", json!({"refiner": paid})).await.problem(403);
    }
    assert_eq!((calls(&mock), mock.checks()), (0, 0));
}

#[tokio::test]
async fn a_job_of_the_cascade_shows_both_verdicts_and_why_it_went_on() {
    let dir = TempDir::new().unwrap();
    let mock = MockMllm::start(Script {
        reason: Box::new(|call| {
            let answer = json!({
                "reasoning": "because", "ranking": call.labels(), "certainty": "likely",
            });
            Reply::Text(answer.to_string())
        }),
        ..Script::default()
    })
    .await;
    // Too few images to be calibrated, so that closeness decides alone; any other place is too close.
    let settings = [
        ("WHEREABOUTS_REFINE__REFINER", "cascade"),
        ("WHEREABOUTS_CASCADE__CLOSE", "0"),
        ("WHEREABOUTS_CASCADE__CANDIDATES", "2"),
    ];
    let server = start(&dir, &mock, &settings);
    server.put("/maps/m", json!({"scene": "outdoor", "frame": "metric"})).await.expect(201);
    for place in 0..5 {
        let path = format!("/maps/m/images?id=place-{place}&x={}&y=0", 100 * place);
        server.post_jpeg(&path, reference(place)).await.expect(201);
    }
    let ended = job(&server, "").await;
    assert_eq!((&ended["refiner"], &ended["state"]), (&json!("cascade"), &json!("succeeded")));
    assert_eq!((mock.describe_calls(), mock.reason_calls()), (2, 1));
    let [first, second] = ended["verdicts"].as_array().unwrap().as_slice() else {
        panic!("{ended}")
    };
    assert_eq!((&first["refiner"], &second["refiner"]), (&json!("local"), &json!("mllm")));
    assert!(first["then"].as_str().unwrap().contains("cascade.close"), "{first}");
    assert_eq!((&first["compared"], &second["compared"]), (&json!(5), &json!(2)));
    assert_eq!((&second["certainty"], &second["then"]), (&json!("likely"), &Value::Null));
    assert_eq!(ended["ranking"].as_array().unwrap().len(), 5);
    assert_eq!(ended["descriptions"].as_array().unwrap().len(), 5);
    assert_eq!(mock.violations(), [""; 0]);
}
