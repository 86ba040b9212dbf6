//! Whether what is to be written is something that is read.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs::{self, Metadata};
use std::os::unix::fs::MetadataExt;
use std::path::{Component, Path, PathBuf};

/// A file and what it is to a command, as in `` `run.rrd` (--rrd) ``.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileNamed {
    pub role: String,
    pub path: PathBuf,
}

impl fmt::Display for FileNamed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}` ({})", self.path.display(), self.role)
    }
}

/// What a piece of work reads and writes, to be checked before anything is created.
///
/// Two names are of one file if device and inode are the same, whatever links lead there; names of
/// files that do not exist yet, if they resolve to the same place.
#[derive(Debug, Clone, Default)]
pub struct Files {
    inputs: Vec<(FileNamed, Extent)>,
    outputs: Vec<(FileNamed, Target)>,
}

/// How far an input reaches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Extent {
    /// The file; of a folder all there is and will be.
    Closed,
    /// The files that a folder has now.
    Open,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Target {
    File,
    /// Files in sub-directories of it.
    Tree,
}

/// Why nothing may be written.
#[derive(Debug, thiserror::Error)]
pub enum FilesError {
    #[error("{output} is {input}, which would be lost: give the output another name")]
    OverInput { output: FileNamed, input: FileNamed },
    #[error("{output} lies in {input}, into which nothing is written: give a place outside of it")]
    InInput { output: FileNamed, input: FileNamed },
    #[error("{input} lies in {output}, where it could be overwritten: give another directory")]
    AroundInput { output: FileNamed, input: FileNamed },
    #[error("{first} and {second} are one file: give them different names")]
    Twice { first: FileNamed, second: FileNamed },
    #[error("{output} is a directory: give the name of a file")]
    IsDirectory { output: FileNamed },
    #[error("{}: {source}", .input.path.display())]
    Unreadable { input: FileNamed, source: std::io::Error },
}

impl FilesError {
    /// Whether names contradict each other, in contrast to what the disk holds.
    pub fn is_wrong_usage(&self) -> bool {
        !matches!(self, Self::IsDirectory { .. } | Self::Unreadable { .. })
    }
}

impl Files {
    pub fn new() -> Self {
        Self::default()
    }

    /// `path` is read: a file, or a folder into which nothing may be written.
    pub fn reads(&mut self, role: &str, path: &Path) -> &mut Self {
        self.inputs.push((named(role, path), Extent::Closed));
        self
    }

    /// Files in the folder `path` are read, and others may be written beside them.
    pub fn reads_from(&mut self, role: &str, path: &Path) -> &mut Self {
        self.inputs.push((named(role, path), Extent::Open));
        self
    }

    /// The file `path` is written.
    pub fn writes(&mut self, role: &str, path: &Path) -> &mut Self {
        self.outputs.push((named(role, path), Target::File));
        self
    }

    /// Files in sub-directories of `path` are written.
    pub fn writes_below(&mut self, role: &str, path: &Path) -> &mut Self {
        self.outputs.push((named(role, path), Target::Tree));
        self
    }

    /// Compares every output with every input and every other output. Touches nothing; the files
    /// of input folders are looked through only where an output exists already.
    ///
    /// # Errors
    /// The first pair that is one file, an input that cannot be looked at, an output that is a
    /// directory.
    pub fn check(&self) -> Result<(), FilesError> {
        let mut inputs = Vec::new();
        for (input, extent) in &self.inputs {
            let found = fs::metadata(&input.path)
                .map_err(|source| FilesError::Unreadable { input: input.clone(), source })?;
            inputs.push((input, *extent, Place::of(&input.path), found));
        }
        let outputs: Vec<_> = self
            .outputs
            .iter()
            .filter(|(output, _)| !is_stream(&output.path))
            .map(|(output, target)| (output, *target, Place::of(&output.path)))
            .collect();
        for (k, (output, target, place)) in outputs.iter().enumerate() {
            for (input, extent, other, found) in &inputs {
                let pair = || (FileNamed::clone(output), FileNamed::clone(input));
                compare(place, *target, other, *extent, found.is_dir()).map_err(|e| e(pair()))?;
            }
            if *target == Target::File && output.path.is_dir() {
                return Err(FilesError::IsDirectory { output: FileNamed::clone(output) });
            }
            let is_twice = |first: &Place, of: Target| {
                of == Target::File && *target == Target::File && first.meets(place)
            };
            if let Some((first, ..)) = outputs[..k].iter().find(|(_, of, p)| is_twice(p, *of)) {
                let (first, second) = (FileNamed::clone(first), FileNamed::clone(output));
                return Err(FilesError::Twice { first, second });
            }
        }
        let existing: BTreeMap<_, _> =
            outputs.iter().filter_map(|(output, _, place)| Some((place.id?, output))).collect();
        let folders = inputs.iter().filter(|(.., found)| found.is_dir() && !existing.is_empty());
        for (input, ..) in folders {
            let mut ids = BTreeSet::new();
            collect_files(&input.path, &mut BTreeSet::new(), &mut ids);
            if let Some(output) = existing.iter().find_map(|(id, o)| ids.contains(id).then_some(o))
            {
                let (output, input) = (FileNamed::clone(output), FileNamed::clone(input));
                return Err(FilesError::OverInput { output, input });
            }
        }
        Ok(())
    }
}

fn named(role: &str, path: &Path) -> FileNamed {
    FileNamed { role: role.to_owned(), path: path.to_owned() }
}

type Refusal = fn((FileNamed, FileNamed)) -> FilesError;

/// Refuses an output at `place` beside an input at `other`.
fn compare(
    place: &Place,
    target: Target,
    other: &Place,
    extent: Extent,
    is_folder: bool,
) -> Result<(), Refusal> {
    let same = place.id.is_some() && place.id == other.id || place.path == other.path;
    match target {
        Target::File if same && !is_folder => {
            Err(|(output, input)| FilesError::OverInput { output, input })
        }
        _ if extent == Extent::Closed && place.path.starts_with(&other.path) => {
            Err(|(output, input)| FilesError::InInput { output, input })
        }
        Target::Tree if other.path.strip_prefix(&place.path).is_ok_and(is_nested) => {
            Err(|(output, input)| FilesError::AroundInput { output, input })
        }
        _ => Ok(()),
    }
}

/// Whether a relative path leads through a directory.
fn is_nested(path: &Path) -> bool {
    path.components().nth(1).is_some()
}

/// Pipes and devices are neither harmed nor doubled.
fn is_stream(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir())
}

type Id = (u64, u64);

fn id(found: &Metadata) -> Id {
    (found.dev(), found.ino())
}

/// Where a name leads.
struct Place {
    /// Of the file that is there.
    id: Option<Id>,
    /// Absolute, links followed as far as there is something.
    path: PathBuf,
}

impl Place {
    fn of(path: &Path) -> Self {
        let found = fs::metadata(path).ok().filter(Metadata::is_file);
        Self { id: found.as_ref().map(id), path: resolved(path) }
    }

    /// Whether these are one file, or one would have to be a directory for the other.
    fn meets(&self, other: &Self) -> bool {
        self.id.is_some() && self.id == other.id
            || self.path.starts_with(&other.path)
            || other.path.starts_with(&self.path)
    }
}

/// Links that are followed before they count as a loop.
const MOST_LINKS: usize = 40;

/// The place that `path` stands for, also where there is nothing yet.
pub fn resolved(path: &Path) -> PathBuf {
    let mut path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    for _ in 0..MOST_LINKS {
        let Ok(target) = fs::read_link(&path) else { break };
        path = path.parent().map_or_else(|| target.clone(), |folder| folder.join(&target));
    }
    let known = path.ancestors().find_map(|ancestor| {
        Some((ancestor.canonicalize().ok()?, path.strip_prefix(ancestor).ok()?))
    });
    let Some((mut place, rest)) = known else { return path };
    for component in rest.components() {
        match component {
            Component::ParentDir => {
                place.pop();
            }
            other => place.push(other),
        }
    }
    place
}

/// Adds the files in and below `folder`, each directory once whatever links lead to it.
fn collect_files(folder: &Path, seen: &mut BTreeSet<Id>, files: &mut BTreeSet<Id>) {
    let new = fs::metadata(folder).is_ok_and(|found| seen.insert(id(&found)));
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.filter(|_| new).flatten() {
        match fs::metadata(entry.path()) {
            Ok(found) if found.is_dir() => collect_files(&entry.path(), seen, files),
            Ok(found) => {
                files.insert(id(&found));
            }
            Err(_) => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    /// A folder with `log.mcap`, `ref.tum` and the recording `rec/data/1.png`.
    fn scene() -> tempfile::TempDir {
        let scene = tempfile::tempdir().unwrap();
        fs::create_dir_all(scene.path().join("rec/data")).unwrap();
        for name in ["log.mcap", "ref.tum", "rec/data/1.png"] {
            fs::write(scene.path().join(name), name).unwrap();
        }
        scene
    }

    fn check(scene: &Path, inputs: &[&str], outputs: &[&str]) -> Result<(), FilesError> {
        let mut files = Files::new();
        for input in inputs {
            files.reads("LOG", &scene.join(input));
        }
        for output in outputs {
            files.writes("--out", &scene.join(output));
        }
        files.check()
    }

    #[test]
    fn every_name_of_an_input_is_refused() {
        let scene = scene();
        let path = scene.path();
        symlink("log.mcap", path.join("link")).unwrap();
        symlink("link", path.join("link_to_link")).unwrap();
        symlink(".", path.join("here")).unwrap();
        fs::hard_link(path.join("log.mcap"), path.join("hard")).unwrap();
        fs::hard_link(path.join("rec/data/1.png"), path.join("hard.png")).unwrap();
        symlink("rec/data/1.png", path.join("link.png")).unwrap();
        for output in
            ["log.mcap", "./rec/../log.mcap", "link", "link_to_link", "here/log.mcap", "hard"]
        {
            let error = check(path, &["log.mcap"], &[output]).unwrap_err();
            assert!(matches!(error, FilesError::OverInput { .. }), "{output}: {error}");
            assert!(error.is_wrong_usage());
        }
        for output in ["rec/data/1.png", "rec/new/run", "here/rec/x", "log.mcap/run"] {
            let error = check(path, &["rec", "log.mcap"], &[output]).unwrap_err();
            assert!(matches!(error, FilesError::InInput { .. }), "{output}: {error}");
        }
        for output in ["hard.png", "link.png"] {
            assert!(check(path, &["rec"], &[output]).is_err(), "{output}");
        }
        assert!(check(path, &["log.mcap", "ref.tum", "rec"], &["other", "recording/x"]).is_ok());
    }

    #[test]
    fn outputs_do_not_name_each_other() {
        let scene = scene();
        symlink("new", scene.path().join("dangling")).unwrap();
        let twice = |a: &str, b: &str| match check(scene.path(), &[], &[a, b]) {
            Ok(()) => false,
            Err(FilesError::Twice { .. }) => true,
            Err(error) => panic!("{error}"),
        };
        assert!(twice("new", "new") && twice("dangling", "new") && twice("a/../new", "new"));
        assert!(twice("ref.tum", "ref.tum") && twice("run", "run/state.csv"));
        assert!(!twice("new", "newer") && !twice("ref.tum", "log.mcap"));
    }

    #[test]
    fn what_is_no_file_is_said_before_the_work() {
        let scene = scene();
        let absent = check(scene.path(), &["absent"], &[]).unwrap_err();
        assert!(matches!(&absent, FilesError::Unreadable { .. }) && !absent.is_wrong_usage());
        let directory = check(scene.path(), &["log.mcap"], &["rec"]).unwrap_err();
        assert!(matches!(directory, FilesError::IsDirectory { .. }), "{directory}");
        assert!(check(Path::new("/dev"), &["null"], &["null", "null"]).is_ok());
    }

    #[test]
    fn files_beside_a_run_and_below_a_directory() {
        let scene = scene();
        let path = scene.path();
        let mut files = Files::new();
        files.reads_from("DIR", &path.join("rec/data")).writes("--plot", &path.join("rec/data/2"));
        assert!(files.check().is_ok());
        files.writes("--report", &path.join("rec/data/1.png"));
        assert!(matches!(files.check(), Err(FilesError::OverInput { .. })));
        let below = |input: &str| {
            let mut files = Files::new();
            files.reads("LOG", &path.join(input)).writes_below("--out", path);
            files.check().is_ok()
        };
        assert!(below("log.mcap") && !below("rec/data/1.png"));
        let mut files = Files::new();
        files.writes("--out", &path.join("results.json"));
        files.writes_below("--out", path).writes_below("--cache", path);
        assert!(files.check().is_ok());
    }
}
