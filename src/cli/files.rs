//! Which arguments name files that are read and which ones that are written: the one place that
//! sees to it that no output harms an input, for every command alike.

use std::path::PathBuf;

use clap::{Arg, ArgMatches, Command};
use mfg_vio::output::{Files, resolved};

use super::results::Results;

/// Arguments that name what is written; all other paths are read.
const OUTPUTS: [&str; 9] = [
    "out",
    "output",
    "rrd",
    "plot",
    "report",
    "save_map",
    "write_config",
    "write_calibration",
    "write_guard",
];
/// Arguments that name what is neither: a folder that the program keeps for itself.
const OWN: [&str; 1] = ["cache"];
/// Arguments that name logs. If they are folders, nothing is written into them.
const LOGS: [&str; 3] = ["log", "input", "root"];

/// Compares all files that the command line names, before anything is created, and removes what
/// an earlier run left where this one will write.
///
/// # Errors
/// [`FilesError`](mfg_vio::output::FilesError) if an output is an input or another output.
pub fn prepare(command: &Command, matches: &ArgMatches) -> anyhow::Result<()> {
    let (path, command, matches) = innermost(command, matches);
    let mut files = Files::new();
    // A recording may be wanted where it would lie anyway.
    let recording = paths(matches, "rrd").into_iter().map(|path| resolved(path)).next();
    let mut earlier = Vec::new();
    for argument in command.get_arguments() {
        let id = argument.get_id().as_str();
        if OWN.contains(&id) {
            continue;
        }
        for value in paths(matches, id) {
            let role = role(argument);
            if !OUTPUTS.contains(&id) {
                if LOGS.contains(&id) || !value.is_dir() {
                    files.reads(&role, value);
                } else {
                    files.reads_from(&role, value);
                }
            } else if is_directory(argument) {
                let results = if id == "out" { Results::of(&path) } else { Results::runs() };
                results.declare(&mut files, &role, value, recording.as_deref());
                earlier.push((results, value.clone()));
            } else {
                files.writes(&role, value);
            }
        }
    }
    files.check()?;
    earlier.iter().try_for_each(|(results, directory)| results.remove(directory))
}

/// The command that is run, by its name after that of the program.
fn innermost<'a>(
    mut command: &'a Command,
    mut matches: &'a ArgMatches,
) -> (String, &'a Command, &'a ArgMatches) {
    let mut names = Vec::new();
    while let Some((name, inner)) = matches.subcommand() {
        let Some(found) = command.find_subcommand(name) else { break };
        names.push(name);
        (command, matches) = (found, inner);
    }
    (names.join(" "), command, matches)
}

/// The values of an argument, if they are paths.
fn paths<'a>(matches: &'a ArgMatches, id: &str) -> Vec<&'a PathBuf> {
    matches.try_get_many::<PathBuf>(id).ok().flatten().into_iter().flatten().collect()
}

/// `--truth`, or `LOG` for what has no flag.
fn role(argument: &Arg) -> String {
    match argument.get_long() {
        Some(long) => format!("--{long}"),
        None => argument.get_value_names().and_then(|names| names.first()).map_or_else(
            || argument.get_id().as_str().to_uppercase(),
            |name| name.as_str().to_owned(),
        ),
    }
}

fn is_directory(argument: &Arg) -> bool {
    argument.get_value_names().is_some_and(|names| names.iter().any(|name| name == "DIR"))
}

#[cfg(test)]
mod tests {
    use std::any::TypeId;

    use clap::CommandFactory;

    use super::*;

    /// Arguments that name files which are read, beside [`LOGS`].
    const INPUTS: [&str; 12] = [
        "guard",
        "config",
        "directories",
        "directory",
        "estimates",
        "gps",
        "imu",
        "map",
        "reference",
        "trajectory",
        "truth",
        "files",
    ];

    fn visit(command: &Command, path: &str, found: &mut Vec<(String, Arg)>) {
        for argument in command.get_arguments() {
            let type_id = argument.get_value_parser().type_id();
            if type_id == TypeId::of::<PathBuf>() {
                found.push((path.trim().to_owned(), argument.clone()));
            }
        }
        for inner in command.get_subcommands() {
            visit(inner, &format!("{path} {}", inner.get_name()), found);
        }
    }

    #[test]
    fn every_path_of_every_command_is_known_as_input_or_output() {
        let mut command = super::super::Cli::command();
        command.build();
        let mut found = Vec::new();
        visit(&command, "", &mut found);
        assert!(found.len() > 25, "{}", found.len());
        for (path, argument) in found {
            let id = argument.get_id().as_str();
            let lists: [&[&str]; 4] = [&OUTPUTS, &OWN, &LOGS, &INPUTS];
            let known = lists.iter().any(|list| list.contains(&id));
            assert!(known, "`{path}`: say of the path `{id}` whether it is read or written");
            if OUTPUTS.contains(&id) && is_directory(&argument) {
                assert!(Results::is_known(&path), "say what `{path}` writes into a directory");
            }
        }
    }
}
