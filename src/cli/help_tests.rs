//! Snapshots of the help of every command, and of the errors of wrong usage.
//!
//! After an intended change, run the tests once with `INSTA_UPDATE=always` and review the difference.

use clap::{Command, CommandFactory, Parser};

use super::Cli;

/// A command whose help depends neither on the terminal nor on the environment.
fn reproducible(command: Command) -> Command {
    command.term_width(100).mut_args(|arg| arg.hide_env_values(true)).mut_subcommands(reproducible)
}

/// The help of a command, followed by that of its subcommands.
fn help(command: &mut Command) -> String {
    let mut text = command.render_long_help().to_string();
    for subcommand in command.get_subcommands_mut().filter(|one| one.get_name() != "help") {
        text.push_str("\n----------------------------------------\n\n");
        text.push_str(&help(subcommand));
    }
    text
}

#[test]
fn every_command_has_help() {
    let mut cli = reproducible(Cli::command());
    cli.build();
    insta::assert_snapshot!("whereabouts", cli.render_long_help().to_string());
    for command in cli.get_subcommands_mut().filter(|one| one.get_name() != "help") {
        let name = command.get_name().to_owned();
        insta::assert_snapshot!(name, help(command));
    }
}

#[test]
fn every_argument_is_documented() {
    fn check(command: &Command) {
        assert!(command.get_about().is_some(), "{} has no description", command.get_name());
        for arg in command.get_arguments() {
            let documented = arg.get_help().is_some();
            assert!(documented, "{} {} is not documented", command.get_name(), arg.get_id());
        }
        command.get_subcommands().for_each(check);
    }
    let mut cli = Cli::command();
    cli.build();
    check(&cli);
}

#[test]
fn wrong_usage_is_explained() {
    let usages: [&[&str]; 12] = [
        &["localize", "frame.jpg"],
        &["localize", "frame.jpg", "--map", "no spaces"],
        &["index", "--map", "town"],
        &["index", "images", "--reindex", "--map", "town"],
        &["jobs", "--wait", "10"],
        &["jobs", "--state", "lost"],
        &["backup", "backup.tar", "--concurrency", "0"],
        &["keys", "revoke", "../maps/town"],
        &["keys", "create", "--name", "robot", "--role", "pilot"],
        &["eval", "--database", "a", "--queries", "b", "--hold-out", "1"],
        &["eval", "--database", "a", "--queries", "b", "--known-threshold", "high"],
        &["serve", "--listen", "localhost"],
    ];
    let errors = usages.map(|usage| {
        let args = [&["whereabouts"], usage].concat();
        let error = Cli::try_parse_from(args).expect_err("the usage is wrong");
        format!("$ whereabouts {}\n{error}", usage.join(" "))
    });
    insta::assert_snapshot!("wrong_usage", errors.join("\n"));
}

#[test]
fn the_former_name_of_restart_is_accepted() {
    for flag in ["--restart", "--anew"] {
        assert!(Cli::try_parse_from(["whereabouts", "backup", "backup.tar", flag]).is_ok());
    }
}
