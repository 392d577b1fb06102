//! `whereabouts migrate`.

use std::path::PathBuf;

use anyhow::bail;

use whereabouts_server::config::{Config, Overrides};

/// Makes the tables of the database (database.url, WHEREABOUTS_DATABASE__URL), or brings them up to date. Run it
/// before a new version is started; it may run several times, and several times at once.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// A configuration file
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Only say whether they are up to date: exit code 1 if not
    #[arg(long)]
    check: bool,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let config = Config::load(args.config.as_deref(), &Overrides::default())?;
    if !config.database.is_set() {
        bail!(
            "there is no database: set database.url (WHEREABOUTS_DATABASE__URL). The embedded store needs no \
             migration: a server brings its data folder up to date when it starts"
        );
    }
    migrate_database(&config, args.check).await
}

#[cfg(not(feature = "postgres"))]
async fn migrate_database(_: &Config, _: bool) -> anyhow::Result<()> {
    bail!("this build cannot use PostgreSQL: build with the Cargo feature `postgres`")
}

#[cfg(feature = "postgres")]
async fn migrate_database(config: &Config, check_only: bool) -> anyhow::Result<()> {
    use whereabouts_server::startup;
    use whereabouts_store::postgres::{SchemaState, migrate, schema_of};

    let settings = startup::postgres_settings(config);
    if check_only {
        match schema_of(&settings).await? {
            SchemaState::UpToDate => println!("the tables are up to date"),
            SchemaState::Behind { steps } => {
                bail!(
                    "the tables are not up to date (steps missing: {steps}); run `whereabouts migrate`"
                )
            }
            SchemaState::Ahead { version } => {
                bail!("the tables are of version {version}, which this program does not know")
            }
        }
        return Ok(());
    }
    match migrate(&settings).await? {
        0 => println!("the tables are up to date; nothing to do"),
        1 => println!("one step was taken; the tables are up to date"),
        steps => println!("{steps} steps were taken; the tables are up to date"),
    }
    Ok(())
}
