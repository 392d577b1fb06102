//! What verdicts of the refiner `local` add to tracks: a server is sent the frames of a drive, once without jobs and once
//! with one for each frame, whose verdict enters [`LAG`] frames later.

use std::time::Duration;

use anyhow::{Context, bail};
use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabouts_testkit::server::Server;
use whereabouts_testkit::wait::eventually_within;

use super::robots::Located;
use super::sets::Drive;

/// Number of frames after which a verdict has arrived.
const LAG: usize = 3;

/// A server with the map of a drive.
pub struct Localizer {
    server: Server,
    _folder: TempDir,
}

impl Localizer {
    /// Starts a server, and waits until the map is calibrated. `kind` is that of the descriptors.
    pub async fn new(drive: &Drive, kind: &str) -> anyhow::Result<Self> {
        let folder = TempDir::new()?;
        let settings = [
            // The descriptors are those of the other methods.
            ("WHEREABOUTS_VOCABULARY__OWN", "false"),
            ("WHEREABOUTS_REFINE__REFINER", "local"),
            ("WHEREABOUTS_TRACK__VERDICTS", "true"),
        ];
        let server = Server::start(folder.path(), &settings);
        let map = json!({"scene": "outdoor", "frame": "metric", "descriptor": kind});
        server.put("/maps/m", map).await.expect(201);
        for (number, (picture, (_, [x, y]))) in drive.pictures.iter().zip(&drive.map).enumerate() {
            let path = format!("/maps/m/images?id=image-{number}&x={x}&y={y}");
            server.post_jpeg(&path, picture.to_vec()).await.expect(201);
        }
        eventually_within(Duration::from_secs(300), async || {
            let map = server.get("/maps/m").await.expect(200);
            let measured = &map["calibration"];
            let is_done = measured["images"] == drive.map.len()
                && measured["refined"].as_u64().is_some_and(|refined| refined > 0);
            is_done.then_some(()).ok_or(map)
        })
        .await;
        Ok(Self { server, _folder: folder })
    }

    /// The answers to the frames of a drive.
    pub async fn follow(
        &self,
        drive: &Drive,
        (with_odometry, with_verdicts): (bool, bool),
    ) -> anyhow::Result<Vec<Located>> {
        let refine = if with_verdicts { "async" } else { "off" };
        let track = format!("{with_odometry}-{with_verdicts}");
        let (mut answers, mut jobs) = (Vec::new(), Vec::new());
        for (number, frame) in drive.frames.iter().enumerate() {
            if let Some(job) = number.checked_sub(LAG).and_then(|before| jobs.get(before)) {
                let job: &String = job;
                self.server.get(&format!("/jobs/{job}?wait=60")).await.expect(200);
            }
            let at =
                Timestamp::UNIX_EPOCH + SignedDuration::try_from_secs_f64(1e9 + frame.seconds)?;
            let moved =
                if with_odometry { format!("&moved_m={}", frame.moved_m) } else { String::new() };
            let path =
                format!("/localize?map=m&refine={refine}&track={track}&captured_at={at}{moved}");
            let answer = self.server.post_jpeg(&path, frame.picture.to_vec()).await.expect(200);
            if with_verdicts {
                let job = answer["job"]["id"].as_str();
                jobs.push(job.with_context(|| format!("no job: {answer}"))?.to_owned());
            }
            answers.push(located(&answer["track"])?);
        }
        Ok(answers)
    }
}

fn located(track: &Value) -> anyhow::Result<Located> {
    let number = |field: &str| track[field].as_f64().with_context(|| format!("{track}"));
    let Some(known) = track["known"].as_bool() else { bail!("{track}") };
    let image =
        track["image_id"].as_str().and_then(|id| id.trim_start_matches("image-").parse().ok());
    Ok(Located { image, probability: number("probability")?, known, off_map: number("off_map")? })
}
