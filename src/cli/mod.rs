//! The commands: one file each, each a thin shell over the library.

mod attitude;
#[cfg(feature = "vision")]
mod bench;
mod convert;
#[cfg(feature = "vision")]
mod demo;
mod evaluate;
mod experiment;
#[cfg(feature = "vision")]
mod faults;
mod fisher;
mod gnss;
mod info;
#[cfg(feature = "vision")]
mod replay;
mod simulate;
mod terminal;

use std::io::ErrorKind;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

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
    Convert(convert::Args),
    Info(info::Args),
    Evaluate(evaluate::EvaluateArgs),
    Experiment(experiment::ExperimentArgs),
    Fisher(fisher::FisherArgs),
    Gnss(gnss::GnssArgs),
}

/// Parses the command line and runs it: exit status 0, 1 after a failure, 2 on wrong usage.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    terminal::start_messages(cli.verbose);
    let done = match cli.command {
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
        Command::Convert(args) => convert::run(&args),
        Command::Info(args) => info::run(&args),
        Command::Evaluate(args) => evaluate::run(args),
        Command::Experiment(args) => experiment::run(&args),
        Command::Fisher(args) => fisher::run(&args),
        Command::Gnss(args) => gnss::run(&args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) if is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("mfg-vio: {}", in_one_line(&error));
            ExitCode::FAILURE
        }
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

/// A reader that went away (`| head`) is no failure.
fn is_broken_pipe(error: &anyhow::Error) -> bool {
    let io = error.chain().find_map(|cause| cause.downcast_ref::<std::io::Error>());
    io.is_some_and(|io| io.kind() == ErrorKind::BrokenPipe)
}
