//! The real server, started for a benchmark and ended with it.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use anyhow::Context;

pub struct Server {
    pub child: Child,
    pub url: String,
    pub http: reqwest::Client,
}

impl Server {
    #[allow(dead_code, reason = "not every benchmark needs both")]
    pub fn start(model: &str, data: &Path) -> anyhow::Result<Self> {
        Self::start_with(model, data, &[])
    }

    /// `settings` are environment variables.
    pub fn start_with(model: &str, data: &Path, settings: &[(&str, &str)]) -> anyhow::Result<Self> {
        let address_file = data.join("address");
        let mut child = Command::new(env!("CARGO_BIN_EXE_whereabouts"))
            .args(["serve", "--model", model, "--listen", "127.0.0.1:0", "--data"])
            .arg(data.join("data"))
            .arg("--address-file")
            .arg(&address_file)
            .env("WHEREABOUTS_LOG__FORMAT", "json")
            .envs(settings.iter().copied())
            .stderr(Stdio::piped())
            .spawn()?;
        let mut log = BufReader::new(child.stderr.take().context("no log")?).lines();
        while !log.next().context("the server ended")??.contains("\"ready\"") {}
        std::thread::spawn(move || log.for_each(drop));
        let address = std::fs::read_to_string(address_file)?;
        Ok(Self { child, url: format!("http://{}", address.trim()), http: reqwest::Client::new() })
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
