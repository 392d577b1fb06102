//! `whereabouts openapi`.

pub fn run() -> anyhow::Result<()> {
    println!("{}", whereabouts_server::http::openapi().to_pretty_json()?);
    Ok(())
}
