//! `whereabouts completions` and `whereabouts man`.

use std::path::PathBuf;

use anyhow::Context;
use clap::CommandFactory;
use clap_complete::Shell;

use super::Cli;

/// Print a script that completes commands and options in a shell
///
/// For bash: `whereabouts completions bash > ~/.local/share/bash-completion/completions/whereabouts`. For zsh, write it to
/// a file `_whereabouts` in a folder of `$fpath`; for fish, to `~/.config/fish/completions/whereabouts.fish`.
#[derive(Debug, clap::Args)]
pub struct CompletionsArgs {
    /// The shell
    shell: Shell,
}

/// Write the manual pages
///
/// `whereabouts man --out ~/.local/share/man/man1` makes `man whereabouts` and `man whereabouts-serve` work.
#[derive(Debug, clap::Args)]
pub struct ManArgs {
    /// The folder to write a page for each command to. Without it, the page of `whereabouts` is printed
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
}

pub fn completions(args: &CompletionsArgs) -> anyhow::Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), "whereabouts", &mut script);
    print!("{}", String::from_utf8(script)?);
    Ok(())
}

pub fn man(args: &ManArgs) -> anyhow::Result<()> {
    let command = Cli::command();
    let Some(folder) = &args.out else {
        let mut page = Vec::new();
        clap_mangen::Man::new(command).render(&mut page)?;
        print!("{}", String::from_utf8(page)?);
        return Ok(());
    };
    std::fs::create_dir_all(folder)
        .and_then(|()| clap_mangen::generate_to(command, folder))
        .with_context(|| format!("the manual pages cannot be written to {}", folder.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_has_a_manual_page() {
        let dir = tempfile::tempdir().unwrap();
        man(&ManArgs { out: Some(dir.path().join("share/man1")) }).unwrap();
        for command in Cli::command().get_subcommands().filter(|one| !one.is_hide_set()) {
            let page = dir.path().join(format!("share/man1/whereabouts-{}.1", command.get_name()));
            let page = std::fs::read_to_string(&page).unwrap_or_else(|_| panic!("{page:?}"));
            assert!(page.contains("DESCRIPTION"), "{page}");
        }
        let file = dir.path().join("file");
        std::fs::write(&file, "").unwrap();
        let error = man(&ManArgs { out: Some(file) }).unwrap_err().to_string();
        assert!(error.contains("file"), "{error}");
    }

    #[test]
    fn completions_know_every_command() {
        for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), "whereabouts", &mut script);
            let script = String::from_utf8(script).unwrap();
            for command in Cli::command().get_subcommands() {
                assert!(script.contains(command.get_name()), "{shell}: {}", command.get_name());
            }
        }
    }
}
