//! The commands: one file each, each a thin shell over the library.

mod argument;
mod attitude;
#[cfg(feature = "vision")]
mod bench;
mod config;
mod convert;
#[cfg(feature = "vision")]
mod demo;
mod evaluate;
mod experiment;
#[cfg(feature = "vision")]
mod faults;
mod files;
mod fisher;
mod gnss;
mod imu_noise;
mod info;
#[cfg(feature = "vision")]
mod replay;
mod results;
mod simulate;
mod terminal;

use std::ffi::OsString;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use mfg_vio::output::FilesError;

/// Visual-inertial odometry whose beliefs about attitude live on SO(3) itself.
#[derive(Debug, Parser)]
#[command(name = "mfg-vio", version, max_term_width = 100, arg_required_else_help = true)]
struct Cli {
    /// More messages on stderr (-v: debug, -vv: trace); RUST_LOG overrides it.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    verbose: u8,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    #[cfg(feature = "vision")]
    Demo(demo::Args),
    #[cfg(feature = "vision")]
    Replay(replay::Args),
    #[cfg(feature = "vision")]
    Faults(faults::FaultsArgs),
    #[cfg(feature = "vision")]
    Bench(bench::BenchArgs),
    Simulate(simulate::SimulateArgs),
    Attitude(attitude::AttitudeArgs),
    Config(config::Args),
    Convert(convert::Args),
    Info(info::Args),
    Evaluate(evaluate::EvaluateArgs),
    Experiment(experiment::ExperimentArgs),
    Fisher(fisher::FisherArgs),
    Gnss(gnss::GnssArgs),
    ImuNoise(imu_noise::Args),
}

/// The command line contradicts itself in a way that its grammar does not tell.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct WrongUsage(pub String);

/// Parses the command line and runs it: exit status 0, 1 after a failure, 2 on wrong usage,
/// 128 + n after signal n.
pub fn main() -> ExitCode {
    let command = Cli::command();
    let arguments = with_plain_numbers(std::env::args_os());
    let parsed = command
        .clone()
        .try_get_matches_from(arguments)
        .and_then(|matches| Cli::from_arg_matches(&matches).map(|cli| (matches, cli)));
    let (matches, cli) = match parsed {
        Ok(parsed) => parsed,
        Err(error) => return explain(&error),
    };
    terminal::start_messages(cli.verbose);
    let done = files::prepare(&command, &matches).and_then(|()| run(cli.command));
    if let Err(error) = &done {
        terminal::tell(&format!("mfg-vio: {}", in_one_line(error)));
    }
    match (terminal::interruption_status(), done) {
        (Some(status), _) => status.into(),
        (None, Ok(())) => ExitCode::SUCCESS,
        (None, Err(error)) if is_wrong_usage(&error) => ExitCode::from(2),
        (None, Err(_)) => ExitCode::FAILURE,
    }
}

/// Writes negative numbers such as `-.5` and `-5e-1`, which the parser would take for flags, as
/// `-0.5`.
fn with_plain_numbers(arguments: impl Iterator<Item = OsString>) -> Vec<OsString> {
    let plain = |argument: OsString| {
        let text = argument.to_str().filter(|text| text.starts_with('-'));
        let number = text.and_then(|text| text.parse::<f64>().ok());
        match number.filter(|number| number.is_finite()) {
            Some(number) => number.to_string().into(),
            None => argument,
        }
    };
    arguments.map(plain).collect()
}

fn run(command: Command) -> anyhow::Result<()> {
    match command {
        #[cfg(feature = "vision")]
        Command::Demo(args) => demo::run(&args),
        #[cfg(feature = "vision")]
        Command::Replay(args) => replay::run(&args),
        #[cfg(feature = "vision")]
        Command::Faults(args) => faults::run(&args),
        #[cfg(feature = "vision")]
        Command::Bench(args) => bench::run(&args),
        Command::Simulate(args) => simulate::run(args),
        Command::Attitude(args) => attitude::run(&args),
        Command::Config(args) => config::run(&args),
        Command::Convert(args) => convert::run(&args),
        Command::Info(args) => info::run(&args),
        Command::Evaluate(args) => evaluate::run(args),
        Command::Experiment(args) => experiment::run(&args),
        Command::Fisher(args) => fisher::run(&args),
        Command::Gnss(args) => gnss::run(&args),
        Command::ImuNoise(args) => imu_noise::run(&args),
    }
}

/// Prints what is wrong with the command line, or the help that it asks for.
fn explain(error: &clap::Error) -> ExitCode {
    match (error.print(), u8::try_from(error.exit_code())) {
        (Ok(()), Ok(status)) => status.into(),
        _ => ExitCode::FAILURE,
    }
}

/// The error and its causes; a cause that the text before it already tells is left out.
fn in_one_line(error: &anyhow::Error) -> String {
    let mut line = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !line.contains(&cause) {
            line = format!("{line}: {cause}");
        }
    }
    line
}

fn is_wrong_usage(error: &anyhow::Error) -> bool {
    let files = error.downcast_ref::<FilesError>();
    error.is::<WrongUsage>() || files.is_some_and(FilesError::is_wrong_usage)
}
