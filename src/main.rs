//! The command line: `mfg-vio COMMAND`; see `mfg-vio --help`.

mod cli;

use std::process::ExitCode;

fn main() -> ExitCode {
    cli::main()
}
