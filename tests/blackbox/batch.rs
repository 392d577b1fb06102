//! Many images in one request.

use std::time::Duration;

use futures_util::StreamExt;
use reqwest::Method;
use reqwest::multipart::{Form, Part};
use serde_json::{Value, json};

use super::backup::in_order;
use super::support::{Answer, Server, jpeg, reference, server, shared_server};

fn picture(form: Form, name: &str, bytes: Vec<u8>) -> Form {
    form.part("image", Part::bytes(bytes).file_name(name.to_owned()))
}

async fn send(server: &Server, map: &str, form: Form) -> Answer {
    let path = format!("/maps/{map}/images:batch");
    Answer::of(server.request(Method::POST, &path).multipart(form)).await
}

async fn send_tar(server: &Server, map: &str, archive: Vec<u8>) -> Answer {
    server.post(&format!("/maps/{map}/images:batch"), "application/x-tar", archive).await
}

/// The id and the outcome of each image.
fn outcomes(answer: &Value) -> Vec<(String, String)> {
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let results = answer["results"].as_array().unwrap();
    results.iter().map(|result| (text(&result["id"]), text(&result["outcome"]))).collect()
}

fn expected(outcomes: &[(&str, &str)]) -> Vec<(String, String)> {
    outcomes.iter().map(|(id, outcome)| ((*id).to_owned(), (*outcome).to_owned())).collect()
}

fn archive(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut builder = tar::Builder::new(Vec::new());
    for (name, bytes) in entries {
        let mut header = tar::Header::new_gnu();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        builder.append_data(&mut header, name, *bytes).unwrap();
    }
    builder.into_inner().unwrap()
}

#[tokio::test]
async fn images_of_a_request_are_recorded_in_its_order() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({"frame": "metric"})).await.expect(201);
    // Large pictures are stored after small ones that were sent later.
    let names: Vec<String> = (0..24).map(|number| format!("{}.jpg", number * 7 % 24)).collect();
    let mut form = Form::new();
    for (number, name) in names.iter().enumerate() {
        let picture =
            image::RgbImage::from_fn(if number % 5 == 0 { 2400 } else { 64 }, 64, |x, y| {
                image::Rgb([(x * y) as u8, number as u8 * 9, x as u8])
            });
        form = form.part("image", Part::bytes(jpeg(&picture)).file_name(name.clone()));
    }
    assert_eq!(send(server, &map, form).await.expect(200)["stored"], 24);
    assert_eq!(in_order(server, &map).await, names);
}

#[tokio::test]
async fn each_image_of_a_form_has_its_own_result_and_errors_are_isolated() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    let meta = |text: &str| text.to_owned();
    let mut form = Form::new().text("meta", meta(r#"{"id": "a", "pose": {"lat": 1, "lon": 2}}"#));
    form = picture(form, "one.jpg", reference(0));
    form = picture(form, "two.jpg", reference(1));
    form = picture(form, "broken.jpg", b"no picture".to_vec());
    form = form.part("image", Part::bytes(reference(2)));
    form = picture(form.text("meta", meta("no JSON")), "three.jpg", reference(3));
    form = picture(
        form.text("meta", meta(r#"{"pose": {"lat": 91, "lon": 0}}"#)),
        "pole.jpg",
        reference(3),
    );
    form = picture(form.text("meta", meta(r#"{"id": "a"}"#)), "", reference(0));
    form = picture(form.text("meta", meta(r#"{"id": "a"}"#)), "", reference(4));
    let answer = send(server, &map, form).await.expect(200);
    let digest = answer["results"][3]["id"].as_str().unwrap().to_owned();
    assert_eq!(digest.len(), 16, "without a name it is the head of the digest");
    let expected_results = [
        ("a", "stored"),
        ("two.jpg", "stored"),
        ("broken.jpg", "failed"),
        (&digest, "stored"),
        ("", "failed"),
        ("pole.jpg", "failed"),
        ("a", "present"),
        ("a", "failed"),
    ];
    assert_eq!(outcomes(&answer), expected(&expected_results));
    assert_eq!(
        [&answer["stored"], &answer["present"], &answer["failed"]],
        [&json!(3), &json!(1), &json!(4)]
    );
    let kind = |index: usize| answer["results"][index]["problem"]["kind"].as_str().unwrap();
    assert_eq!(
        [kind(2), kind(4), kind(5), kind(7)],
        ["unprocessable", "malformed", "unprocessable", "conflict"]
    );
    assert_eq!(server.get(&format!("/maps/{map}")).await.expect(200)["images"], 3);
    let pose = &server.get(&format!("/maps/{map}/images/a")).await.expect(200)["pose"];
    assert_eq!(*pose, json!({"lat": 1.0, "lon": 2.0}));
}

#[tokio::test]
async fn an_archive_holds_pictures_and_their_metadata_in_sidecar_files() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({"frame": "metric"})).await.expect(201);
    let long = format!("{}/long.jpg", "d".repeat(150));
    let pictures: Vec<_> = (0..5).map(reference).collect();
    let sent = archive(&[
        ("./a.jpg", &pictures[0]),
        ("./a.jpg.json", br#"{"pose": {"x": 1, "y": 2}}"#),
        ("b.jpg.json", br#"{"id": "b", "tags": ["gate"]}"#),
        ("b.jpg", &pictures[1]),
        ("lost.jpg.json", b"{}"),
        (&long, &pictures[2]),
        ("c.jpg", &pictures[3]),
        ("c.jpg.json", b"{"),
        ("d.txt", b"no picture"),
        ("e.jpg", &pictures[4]),
    ]);
    let answer = send_tar(server, &map, sent.clone()).await.expect(200);
    let expected_results = [
        ("a.jpg", "stored"),
        ("b", "stored"),
        ("", "failed"),
        (&long, "stored"),
        ("", "failed"),
        ("d.txt", "failed"),
        ("e.jpg", "stored"),
    ];
    assert_eq!(outcomes(&answer), expected(&expected_results));
    let detail = |index: usize| answer["results"][index]["problem"]["detail"].as_str().unwrap();
    assert!(detail(2).contains("lost.jpg") && detail(4).contains("c.jpg"), "{answer}");
    let image = server.get(&format!("/maps/{map}/images/a.jpg")).await.expect(200);
    assert_eq!(image["pose"], json!({"x": 1.0, "y": 2.0}));
    assert_eq!(
        server.get(&format!("/maps/{map}/images/b")).await.expect(200)["tags"],
        json!(["gate"])
    );
    assert_eq!(answer["updated"], 0);
    let again = send_tar(server, &map, sent).await.expect(200);
    assert_eq!((again["stored"].as_u64(), again["present"].as_u64()), (Some(0), Some(4)));
}

#[tokio::test]
async fn a_malformed_batch_is_rejected_and_keeps_the_images_before_the_error() {
    let (server, map) = shared_server();
    server.put(&format!("/maps/{map}"), json!({})).await.expect(201);
    let problem = server
        .post(&format!("/maps/{map}/images:batch"), "image/jpeg", reference(0))
        .await
        .problem(415);
    assert!(problem.contains("application/x-tar"), "{problem}");
    let nowhere = server.request(Method::POST, "/maps/none/images:batch");
    Answer::of(nowhere.multipart(picture(Form::new(), "a", reference(0)))).await.problem(404);
    send(server, &map, Form::new()).await.problem(400);
    let unknown = Form::new().text("poses", "{}");
    assert!(send(server, &map, unknown).await.problem(400).contains("\"poses\""));
    let lonely = picture(Form::new(), "first", reference(0)).text("meta", "{}");
    assert!(send(server, &map, lonely).await.problem(400).contains("no \"image\" follows"));
    let twice = picture(Form::new().text("meta", "{}").text("meta", "{}"), "a", reference(1));
    assert!(send(server, &map, twice).await.problem(400).contains("in a row"));
    let long = picture(Form::new().text("meta", " ".repeat(70_000)), "a", reference(1));
    assert!(send(server, &map, long).await.problem(413).contains("65536"));

    let whole = archive(&[("second", &reference(1)), ("third", &reference(2))]);
    send_tar(server, &map, whole[..whole.len() * 2 / 3].to_vec()).await.problem(400);
    send_tar(server, &map, b"no archive at all".repeat(100)).await.problem(400);
    let images = server.get(&format!("/maps/{map}/images")).await.expect(200);
    let ids: Vec<_> =
        images["images"].as_array().unwrap().iter().map(|image| &image["id"]).collect();
    assert_eq!(ids, ["first", "second"]);
    let keyed = server
        .request(Method::POST, &format!("/maps/{map}/images:batch"))
        .header("idempotency-key", "k");
    Answer::of(keyed.multipart(picture(Form::new(), "a", reference(0)))).await.problem(400);
}

#[tokio::test]
async fn a_batch_is_unbounded_but_each_of_its_images_is_bounded() {
    let dir = tempfile::tempdir().unwrap();
    let one = reference(0).len();
    let limit = (2 * one).to_string();
    let server = Server::start(
        dir.path(),
        &[
            ("WHEREABOUTS_SERVER__BODY_LIMIT_BYTES", &limit),
            ("WHEREABOUTS_SERVER__BODIES_LIMIT_BYTES", &limit),
            ("WHEREABOUTS_BULK__MEMORY_BYTES", &limit),
            ("WHEREABOUTS_SERVER__BODY_PAUSE_S", "3"),
            ("WHEREABOUTS_SERVER__BODY_TIMEOUT_S", "1"),
            ("WHEREABOUTS_SERVER__REQUEST_TIMEOUT_S", "6"),
            ("WHEREABOUTS_BULK__MAX_IMAGES", "20"),
        ],
    );
    server.put("/maps/m", json!({})).await.expect(201);
    let pictures: Vec<_> = (0..21).map(|place| (place.to_string(), reference(place))).collect();
    let entries: Vec<_> =
        pictures.iter().map(|(name, bytes)| (name.as_str(), &bytes[..])).collect();
    let answer = send_tar(&server, "m", archive(&entries)).await.expect(200);
    assert_eq!(
        (answer["stored"].as_u64(), answer["failed"].as_u64()),
        (Some(20), Some(1)),
        "{answer}"
    );
    assert!(
        answer["results"][20]["problem"]["detail"].as_str().unwrap().contains("bulk.max_images")
    );
    let mut form = Form::new();
    for (name, bytes) in pictures.iter().take(5) {
        form = picture(form, name, bytes.clone());
    }
    assert_eq!(send(&server, "m", form).await.expect(200)["present"], 5);

    let large = picture(Form::new(), "large", vec![0; 2 * one + 1]);
    let large = picture(large, "after", pictures[0].1.clone());
    let zeros = vec![0; 2 * one + 1];
    let archived = archive(&[("large", zeros.as_slice()), ("after", &pictures[0].1)]);
    for (answer, after) in [
        (send(&server, "m", large).await, "stored"),
        (send_tar(&server, "m", archived).await, "present"),
    ] {
        let answer = answer.expect(200);
        let [large, last] = &answer["results"].as_array().unwrap()[..] else { panic!("{answer}") };
        assert_eq!(
            (large["problem"]["kind"].as_str(), last["outcome"].as_str()),
            (Some("too-large"), Some(after))
        );
    }

    // Slow clients are what is tested: one takes longer than a request may and sends more slowly than a body may
    // come, but never pauses for long; the other pauses for too long.
    let whole = archive(&entries[..2]);
    let chunks: Vec<_> = whole.chunks(whole.len() / 6).map(<[u8]>::to_vec).collect();
    let slowly = |chunks: Vec<Vec<u8>>, pause: f64| {
        let chunks = futures_util::stream::iter(chunks).then(move |chunk| async move {
            tokio::time::sleep(Duration::from_secs_f64(pause)).await;
            Ok::<_, std::io::Error>(chunk)
        });
        let request = server.request(Method::POST, "/maps/m/images:batch");
        let request = request.header("content-type", "application/x-tar");
        Answer::of(request.body(reqwest::Body::wrap_stream(chunks)))
    };
    let (steady, paused) = tokio::join!(slowly(chunks.clone(), 1.2), slowly(chunks, 5.0));
    assert_eq!(steady.expect(200)["present"], 2);
    assert!(paused.problem(408).contains("server.body_pause_s"));
}

#[tokio::test]
async fn a_batch_without_an_end_of_a_part_is_not_buffered() {
    let (_dir, server) = server();
    server.put("/maps/m", json!({})).await.expect(201);
    let before = server.resident_bytes();
    // An archive with a name of a gigabyte, and forms whose first part never begins or ends.
    let mut long_name = tar::Header::new_gnu();
    long_name.set_entry_type(tar::EntryType::GNULongName);
    long_name.set_path("././@LongLink").unwrap();
    long_name.set_size(1 << 30);
    long_name.set_cksum();
    let head = bytes::Bytes::copy_from_slice(long_name.as_bytes());
    for (kind, head) in [
        ("application/x-tar", head),
        ("multipart/form-data; boundary=b", bytes::Bytes::from_static(b"--")),
        ("multipart/form-data; boundary=b", bytes::Bytes::from_static(b"--b\r\nx: ")),
    ] {
        let chunk = bytes::Bytes::from(vec![b'x'; 1 << 20]);
        let chunks = std::iter::once(head).chain(std::iter::repeat_n(chunk, 1024));
        let body = futures_util::stream::iter(chunks.map(Ok::<_, std::io::Error>));
        let request =
            server.request(Method::POST, "/maps/m/images:batch").header("content-type", kind);
        // The server closes the connection, possibly before the client has read the response.
        if let Ok(response) = request.body(reqwest::Body::wrap_stream(body)).send().await {
            assert_eq!(response.status(), 400, "{kind}");
        }
    }
    let grown = server.resident_bytes().saturating_sub(before);
    assert!(grown < 50_000_000, "memory grew by {grown} bytes");
    let image = picture(Form::new(), "a", reference(0));
    assert_eq!(send(&server, "m", image).await.expect(200)["stored"], 1);
}
