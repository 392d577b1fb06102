//! Which server a command talks to.

pub use whereabouts_api::{Client, MAX_ATTEMPTS, MAX_PAUSE, explained, segment};

/// Which server a command talks to.
#[derive(Debug, Clone, clap::Args)]
pub struct ServerArg {
    /// The server
    #[arg(long, env = "WHEREABOUTS_SERVER", default_value = "http://127.0.0.1:8080")]
    #[arg(value_name = "URL", global = true)]
    pub server: String,
    /// The API key, where the server asks for one
    #[arg(long, env = "WHEREABOUTS_API_KEY", hide_env_values = true, value_name = "KEY")]
    #[arg(global = true)]
    pub api_key: Option<String>,
}

impl ServerArg {
    /// A client of this server.
    pub fn client(&self) -> anyhow::Result<Client> {
        Client::new(&self.server, self.api_key.as_deref())
    }
}
