//! The OpenVINO provider, whose library `make openvino` gets. `tests/optional.sh` runs these tests where it is.

use tempfile::TempDir;

use crate::support::{Server, frame};
use crate::wait::until;

#[tokio::test]
#[ignore = "needs OpenVINO: run `make openvino`"]
async fn another_provider_gives_the_same_descriptors_and_another_precision_is_a_conflict() {
    let dir = TempDir::new().unwrap();
    let start = |provider, precision| {
        let settings = [
            ("WHEREABOUTS_MODEL__PROVIDER", provider),
            ("WHEREABOUTS_MODEL__PRECISION", precision),
        ];
        Server::start(dir.path(), &settings)
    };
    let localize = async |server: &Server| {
        let answer = server.post_jpeg("/localize?map=m&refine=off", frame(1, 0)).await.expect(200);
        let candidates = answer["candidates"].as_array().unwrap().clone();
        candidates.iter().map(|one| one["similarity"].as_f64().unwrap()).collect::<Vec<_>>()
    };
    let server = start("cpu", "auto");
    server.town("m", 4).await;
    assert_eq!(server.get("/maps/m").await.expect(200)["precision"], "full");
    let by_cpu = localize(&server).await;
    server.terminate();
    // auto keeps the precision of the maps.
    let server = start("openvino", "auto");
    assert!(server.log().contains("openvino at full precision"), "{}", server.log());
    for (one, other) in localize(&server).await.iter().zip(&by_cpu) {
        assert!((one - other).abs() < 1e-4, "{one} is not {other}");
    }
    server.terminate();
    let server = start("openvino", "bf16");
    let refused = server.post_jpeg("/localize?map=m&refine=off", frame(1, 0)).await.problem(409);
    assert!(refused.contains("model.precision"), "{refused}");
    server.town("b", 2).await;
    assert_eq!(server.get("/maps/b").await.expect(200)["precision"], "bf16");
    // As the error advises: a reindex computes the descriptors again.
    assert!(refused.contains("--reindex --map m"), "{refused}");
    server.post("/maps/m/reindex", "application/json", Vec::new()).await.expect(202);
    until(async || server.get("/maps/m").await.expect(200)["precision"] != "full").await;
    assert_eq!(localize(&server).await.len(), 4);
}
