//! A webhook receiver: it keeps the messages, verifies their signatures with code of its own, and answers from a
//! script.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::Router;
use axum::body::to_bytes;
use axum::extract::Request;
use axum::http::HeaderMap;
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use reqwest::{Method, StatusCode};
use ring::hmac;
use serde_json::Value;

use crate::wait::eventually_within;

/// How a receiver answers.
#[derive(Clone)]
pub enum Reply {
    Status(u16),
    /// A status with a header.
    With(u16, &'static str, String),
    /// No response.
    Silence,
}

/// A received message.
#[derive(Clone)]
pub struct Message {
    pub path: String,
    headers: HeaderMap,
    pub body: Vec<u8>,
}

impl Message {
    pub fn header(&self, name: &str) -> &str {
        self.headers[name].to_str().unwrap()
    }

    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap()
    }

    /// Verifies the signature as a receiver does.
    #[track_caller]
    pub fn verify(&self, secret: &str) {
        let key = STANDARD.decode(secret.strip_prefix("whsec_").unwrap()).unwrap();
        assert!((24..=64).contains(&key.len()));
        let (id, at) = (self.header("webhook-id"), self.header("webhook-timestamp"));
        let age = jiff::Timestamp::now().as_second() - at.parse::<i64>().unwrap();
        assert!((0..60).contains(&age), "{age}");
        let signed = [format!("{id}.{at}.").as_bytes(), &self.body].concat();
        let signature = self.header("webhook-signature").strip_prefix("v1,").unwrap();
        let signature = STANDARD.decode(signature).unwrap();
        let key = hmac::Key::new(hmac::HMAC_SHA256, &key);
        hmac::verify(&key, &signed, &signature).expect("the signature is wrong");
    }
}

/// A running receiver.
#[derive(Clone)]
pub struct Receiver {
    pub url: String,
    messages: Arc<Mutex<Vec<Message>>>,
    /// The next responses; 200 when there are none left.
    pub replies: Arc<Mutex<VecDeque<Reply>>>,
}

impl Receiver {
    pub async fn start(replies: impl IntoIterator<Item = Reply>) -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let receiver = Self {
            url: format!("http://{}/hook?token=of-the-url", listener.local_addr().unwrap()),
            messages: Arc::default(),
            replies: Arc::new(Mutex::new(replies.into_iter().collect())),
        };
        let taking = receiver.clone();
        let router = Router::new().fallback(move |request: Request| {
            let taking = taking.clone();
            async move { taking.take(request).await }
        });
        tokio::spawn(async move { axum::serve(listener, router).await });
        receiver
    }

    async fn take(self, request: Request) -> Response {
        let (parts, body) = request.into_parts();
        assert_eq!(parts.method, Method::POST);
        let body = to_bytes(body, 1 << 20).await.unwrap().to_vec();
        let path = parts.uri.to_string();
        self.messages.lock().unwrap().push(Message { path, headers: parts.headers, body });
        let reply = self.replies.lock().unwrap().pop_front().unwrap_or(Reply::Status(200));
        let status = |status| StatusCode::from_u16(status).unwrap();
        match reply {
            Reply::Status(code) => (status(code), "an answer").into_response(),
            Reply::With(code, name, value) => (status(code), [(name, value)]).into_response(),
            Reply::Silence => std::future::pending().await,
        }
    }

    pub fn messages(&self) -> Vec<Message> {
        self.messages.lock().unwrap().clone()
    }

    /// Waits until at least `count` messages have come, and returns all of them.
    pub async fn wait(&self, count: usize) -> Vec<Message> {
        eventually_within(Duration::from_secs(30), async || {
            let messages = self.messages();
            match messages.len() {
                received if received < count => Err(format!("{received} of {count} messages came")),
                _ => Ok(messages),
            }
        })
        .await
    }
}
