//! `mfg-vio evaluate`: trajectory error, consistency and comparison of runs.

mod ape;
mod arguments;
mod compare;
mod estimates;
mod inputs;
mod nees;
mod presentation;
mod rpe;

use clap::{Args, Subcommand};

#[derive(Debug, Args)]
pub struct EvaluateArgs {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Absolute pose error: how far aligned estimates are from a reference
    #[command(after_help = ape::HELP)]
    Ape(ape::Args),
    /// Relative pose error: how far the motion over a distance is off
    #[command(after_help = rpe::HELP)]
    Rpe(rpe::Args),
    /// Consistency: are the errors of a run as large as it believes?
    #[command(after_help = nees::HELP)]
    Nees(nees::Args),
    /// One table of many runs
    #[command(after_help = compare::HELP)]
    Compare(compare::Args),
}

pub fn run(args: EvaluateArgs) -> anyhow::Result<()> {
    match args.command {
        Command::Ape(args) => ape::run(&args),
        Command::Rpe(args) => rpe::run(&args),
        Command::Nees(args) => nees::run(&args),
        Command::Compare(args) => compare::run(&args),
    }
}
