//! The arguments of client commands that say which server to talk to.

pub use whereabouts_api::{Client, MAX_ATTEMPTS, MAX_PAUSE, explained, segment};

/// The server that a client command talks to.
#[derive(Debug, Clone, clap::Args)]
pub struct ServerArg {
    /// URL of the server
    #[arg(long, env = "WHEREABOUTS_SERVER", default_value = "http://127.0.0.1:8080")]
    #[arg(value_name = "URL", global = true)]
    pub server: String,
    /// API key, if the server requires one
    #[arg(long, env = "WHEREABOUTS_API_KEY", hide_env_values = true, value_name = "KEY")]
    #[arg(global = true)]
    pub api_key: Option<String>,
}

impl ServerArg {
    /// Creates a client of this server.
    pub fn client(&self) -> anyhow::Result<Client> {
        Client::new(&self.server, self.api_key.as_deref())
    }
}
