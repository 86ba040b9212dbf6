//! What each command writes into the directory that it is given.

use std::io::ErrorKind;
use std::path::Path;

use anyhow::Context;
use mfg_vio::output::{Files, resolved};
use mfg_vio::replay;

const DEMO: [&str; 8] = [
    "demo.mcap",
    "report.html",
    "trajectory.png",
    "error.png",
    "belief.png",
    "nees.png",
    "features.png",
    "timing.png",
];
const ATTITUDE: [&str; 1] = ["attitude.csv"];
const GNSS: [&str; 2] = ["trajectory.tum", "state.csv"];

const BENCH: [&str; 5] =
    ["results.json", "results.csv", "results.tex", "results.html", "sweep.svg"];

/// The files of a command's `--out DIR`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Results {
    names: Vec<&'static str>,
    /// Whether those of an earlier run are of no use to this one.
    are_replaced: bool,
    /// Whether there are sub-directories with results, too.
    has_runs: bool,
}

impl Results {
    pub fn of(command: &str) -> Self {
        // Of a command that is not known anything may be expected.
        Self::known(command).unwrap_or(Self::runs())
    }

    /// Sub-directories that stay.
    pub fn runs() -> Self {
        Self { names: Vec::new(), are_replaced: false, has_runs: true }
    }

    fn known(command: &str) -> Option<Self> {
        let named = |names: &[&'static str]| Self {
            names: names.to_vec(),
            are_replaced: true,
            has_runs: false,
        };
        Some(match command {
            "replay" => named(&replay::RESULTS),
            "demo" => named(&[&replay::RESULTS[..], &DEMO].concat()),
            "attitude" => named(&ATTITUDE),
            "gnss" => named(&GNSS),
            "faults" => Self::runs(),
            // It goes on with the runs that there are.
            "bench" => Self { are_replaced: false, has_runs: true, ..named(&BENCH) },
            // Named by the study; nothing is read.
            "experiment" => named(&[]),
            _ => return None,
        })
    }

    #[cfg(test)]
    pub fn is_known(command: &str) -> bool {
        Self::known(command).is_some()
    }

    /// Adds the files to those that a command writes, but for the one at the place `named`, which
    /// is known by a name of its own.
    pub fn declare(&self, files: &mut Files, role: &str, directory: &Path, named: Option<&Path>) {
        let paths = self.names.iter().map(|name| directory.join(name));
        let is_named = |path: &Path| {
            path.extension().is_some_and(|e| e == "rrd") && named == Some(&resolved(path))
        };
        for path in paths.filter(|path| !is_named(path)) {
            files.writes(role, &path);
        }
        if self.has_runs {
            files.writes_below(role, directory);
        }
    }

    /// Removes what an earlier run left, so that a run that fails does not seem to have succeeded.
    ///
    /// # Errors
    /// If a file cannot be removed.
    pub fn remove(&self, directory: &Path) -> anyhow::Result<()> {
        let names = self.names.iter().filter(|_| self.are_replaced);
        for path in names.map(|name| directory.join(name)) {
            match std::fs::remove_file(&path) {
                Err(error) if !is_absent(&error) => {
                    return Err(error).with_context(|| format!("{}", path.display()));
                }
                _ => {}
            }
        }
        Ok(())
    }
}

fn is_absent(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_results_are_removed() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        for name in ["metrics.json", "run.rrd", "notes.txt", "demo.mcap"] {
            std::fs::write(path(name), name).unwrap();
        }
        Results::of("replay").remove(directory.path()).unwrap();
        assert!(!path("metrics.json").exists() && !path("run.rrd").exists());
        assert!(path("notes.txt").exists() && path("demo.mcap").exists());
        Results::of("replay").remove(&path("absent")).unwrap();
        Results::of("replay").remove(&path("notes.txt")).unwrap();
    }
}
