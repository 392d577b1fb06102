//! Clients that change images of their own and record what the server acknowledged.

use std::sync::Arc;

use serde_json::Value;

use super::ledger::{Fact, Key, Ledger, Stored};
use super::support::{frame, install_cryptography, reference};

/// A seeded random number generator: SplitMix64 (Steele, Lea and Flood, 2014).
#[derive(Debug, Clone)]
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// A number less than `bound`.
    pub fn below(&mut self, bound: usize) -> usize {
        (self.next() % bound as u64) as usize
    }
}

/// Map images, and frames near them.
pub struct Pictures {
    pub images: Vec<Vec<u8>>,
    pub frames: Vec<Vec<u8>>,
}

impl Pictures {
    pub fn draw(count: usize) -> Arc<Self> {
        let images = (0..count).map(reference).collect();
        let frames = (0..count.min(40)).map(|place| frame(place, 0)).collect();
        Arc::new(Self { images, frames })
    }
}

/// A client that works until the server is killed.
pub struct Client {
    pub number: usize,
    pub random: Random,
    pub pictures: Arc<Pictures>,
    pub http: reqwest::Client,
    pub ledger: Ledger,
    /// Number of ids in use so far; only a replacement uses an id twice.
    pub ids: usize,
}

/// The server was killed before it could answer.
pub struct Killed;

impl Client {
    pub fn new(number: usize, seed: u64, pictures: &Arc<Pictures>) -> Self {
        install_cryptography();
        Self {
            number,
            random: Random(seed ^ (number as u64) << 32),
            pictures: Arc::clone(pictures),
            http: reqwest::Client::builder().pool_max_idle_per_host(1).build().unwrap(),
            ledger: Ledger::default(),
            ids: 0,
        }
    }

    /// The map that all clients share, and one of its own, which it sometimes deletes.
    pub fn maps(&self) -> [String; 2] {
        ["shared".into(), format!("own-{}", self.number)]
    }

    /// Works until the server is killed.
    pub async fn work(&mut self, url: &str) {
        while self.step(url).await.is_ok() {}
    }

    async fn step(&mut self, url: &str) -> Result<(), Killed> {
        let map = self.maps()[usize::from(self.random.below(3) == 0)].clone();
        match self.random.below(23) {
            0..=11 => self.add(url, &map).await,
            12..=14 => self.delete(url).await,
            15 => self.replace(url).await,
            16..=18 => self.localize(url).await,
            19..=21 => self.correct(url).await,
            _ => self.delete_map(url).await,
        }
    }

    async fn add(&mut self, url: &str, map: &str) -> Result<(), Killed> {
        self.ids += 1;
        let key = (map.to_owned(), format!("c{}-{}", self.number, self.ids));
        let picture = self.random.below(self.pictures.images.len());
        self.put_map(url, map).await?;
        self.put_image(url, &key, picture).await
    }

    async fn put_map(&self, url: &str, map: &str) -> Result<(), Killed> {
        let body = serde_json::json!({"scene": "outdoor"});
        let request = self.http.put(format!("{url}/maps/{map}")).json(&body);
        send(request, &[200, 201]).await.map(drop)
    }

    async fn put_image(&mut self, url: &str, key: &Key, picture: usize) -> Result<(), Killed> {
        let (map, id) = key;
        self.ledger.begin(key, Some(Stored { picture, pose: 0 }));
        let request = self
            .http
            .post(format!("{url}/maps/{map}/images?id={id}"))
            .header("content-type", "image/jpeg")
            .body(self.pictures.images[picture].clone());
        send(request, &[201]).await?;
        self.ledger.acknowledged(key);
        Ok(())
    }

    async fn delete(&mut self, url: &str) -> Result<(), Killed> {
        let Some((key, _)) = self.ledger.some_present(&mut self.random) else { return Ok(()) };
        self.delete_image(url, &key).await
    }

    async fn delete_image(&mut self, url: &str, key: &Key) -> Result<(), Killed> {
        let (map, id) = key;
        self.ledger.begin(key, None);
        send(self.http.delete(format!("{url}/maps/{map}/images/{id}")), &[204]).await?;
        self.ledger.acknowledged(key);
        Ok(())
    }

    /// Another picture under the same id.
    async fn replace(&mut self, url: &str) -> Result<(), Killed> {
        let Some((key, _)) = self.ledger.some_present(&mut self.random) else { return Ok(()) };
        let picture = self.random.below(self.pictures.images.len());
        self.delete_image(url, &key).await?;
        self.put_image(url, &key, picture).await
    }

    /// Another pose of the same image.
    async fn correct(&mut self, url: &str) -> Result<(), Killed> {
        let present = self.ledger.some_present(&mut self.random);
        let Some((key, stored)) = present else { return Ok(()) };
        let next = Stored { pose: stored.pose + 1, ..stored };
        self.ledger.begin(&key, Some(next));
        let (map, id) = &key;
        let body = serde_json::json!({"pose": {"lat": latitude(next.pose), "lon": 0}});
        let request = self.http.patch(format!("{url}/maps/{map}/images/{id}")).json(&body);
        send(request, &[200]).await?;
        self.ledger.acknowledged(&key);
        Ok(())
    }

    async fn localize(&mut self, url: &str) -> Result<(), Killed> {
        let map = self.maps()[0].clone();
        let frame = self.random.below(self.pictures.frames.len());
        self.put_map(url, &map).await?;
        let request = self
            .http
            .post(format!("{url}/localize?map={map}"))
            .header("content-type", "image/jpeg")
            .body(self.pictures.frames[frame].clone());
        let answer = send(request, &[200]).await?;
        for candidate in answer["candidates"].as_array().unwrap() {
            let id = candidate["image_id"].as_str().unwrap();
            let key = (map.clone(), id.to_owned());
            // A client knows which of its own images exist.
            if !id.starts_with(&format!("c{}-", self.number)) {
                continue;
            }
            let Some(Fact::Acknowledged(Some(stored))) = self.ledger.images.get(&key) else {
                panic!("{key:?} was found after it had been deleted")
            };
            assert_eq!(pose_of(candidate), stored.pose, "{key:?} was found with another pose");
        }
        if let Some(id) = answer["job"]["id"].as_str() {
            self.ledger.jobs.push(id.to_owned());
        }
        Ok(())
    }

    async fn delete_map(&mut self, url: &str) -> Result<(), Killed> {
        let map = self.maps()[1].clone();
        self.ledger.map_deleted(&map, false);
        send(self.http.delete(format!("{url}/maps/{map}")), &[204, 404]).await?;
        self.ledger.map_deleted(&map, true);
        self.ledger.images.retain(|_, fact| *fact != Fact::Acknowledged(None));
        Ok(())
    }
}

/// The latitude that stands for the pose of this number.
fn latitude(pose: u32) -> f64 {
    f64::from(pose) / 1024.0
}

/// The number of the pose of an image or a candidate; 0 without a pose.
pub fn pose_of(image: &Value) -> u32 {
    image["pose"]["lat"].as_f64().map_or(0, |latitude| (latitude * 1024.0) as u32)
}

/// Sends a request; returns its response, which must have one of these statuses.
async fn send(request: reqwest::RequestBuilder, statuses: &[u16]) -> Result<Value, Killed> {
    let response = request.send().await.map_err(|_| Killed)?;
    let status = response.status().as_u16();
    let bytes = response.bytes().await.map_err(|_| Killed)?;
    assert!(statuses.contains(&status), "{status}: {}", String::from_utf8_lossy(&bytes));
    Ok(serde_json::from_slice(&bytes).unwrap_or(Value::Null))
}
