//! `whereabouts migrate`.

use std::path::PathBuf;

use anyhow::bail;

use whereabouts_server::config::{Config, Overrides};

/// Create or upgrade the database schema
///
/// The database is the one of the setting database.url (WHEREABOUTS_DATABASE__URL). Run this before starting
/// a new version. It is safe to run repeatedly, and on several machines at once.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Configuration file
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Only check whether the schema is up to date; the exit code is 1 if it is not
    #[arg(long)]
    check: bool,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let config = Config::load(args.config.as_deref(), &Overrides::default())?;
    if !config.database.is_set() {
        bail!(
            "no database is configured: set database.url (WHEREABOUTS_DATABASE__URL). The embedded store needs \
             no migration: the server upgrades its data folder when it starts"
        );
    }
    migrate_database(&config, args.check).await
}

#[cfg(not(feature = "postgres"))]
async fn migrate_database(_: &Config, _: bool) -> anyhow::Result<()> {
    bail!("this build does not support PostgreSQL: rebuild with the Cargo feature `postgres`")
}

#[cfg(feature = "postgres")]
async fn migrate_database(config: &Config, check_only: bool) -> anyhow::Result<()> {
    use whereabouts_server::startup;
    use whereabouts_store::postgres::{SchemaState, migrate, schema_of};

    let settings = startup::postgres_settings(config);
    if check_only {
        match schema_of(&settings).await? {
            SchemaState::UpToDate => println!("the schema is up to date"),
            SchemaState::Behind { steps } => {
                bail!(
                    "the schema is not up to date (pending migrations: {steps}); run `whereabouts migrate`"
                )
            }
            SchemaState::Ahead { version } => {
                bail!(
                    "the schema has version {version}, which this program does not know; run a program that \
                     is at least as new as the one that migrated the database"
                )
            }
        }
        return Ok(());
    }
    match migrate(&settings).await? {
        0 => println!("the schema is up to date; nothing to do"),
        1 => println!("applied 1 migration; the schema is up to date"),
        migrations => println!("applied {migrations} migrations; the schema is up to date"),
    }
    Ok(())
}
