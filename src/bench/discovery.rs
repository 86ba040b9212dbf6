//! Finds the sequences of a data set under a folder.

use std::path::{Path, PathBuf};

use super::dataset::{Clock, Dataset, Sequence, Source};
use super::error::BenchError;

/// What lies under a folder.
#[derive(Debug, Clone, Default)]
pub struct Found {
    /// In the order of the data set's list, then by name.
    pub sequences: Vec<Sequence>,
    /// Names of the data set's sequences that are not there.
    pub missing: Vec<String>,
}

/// Folders below the one given that are looked into.
const DEPTH: usize = 4;
/// How files that hold a log of messages end.
const MESSAGE_LOGS: [&str; 5] = [".bag", ".mcap", ".mcap.zst", ".db3", ".db3.zstd"];

/// Finds the recordings under `root`, which may be one of them itself. Linear in the entries of
/// the folders above them; nothing is opened.
///
/// # Errors
/// [`BenchError::NothingFound`] if there is none, [`BenchError::Io`] if `root` cannot be read.
pub fn find(dataset: Dataset, root: &Path) -> Result<Found, BenchError> {
    let io = |source| BenchError::Io { path: root.to_owned(), source };
    std::fs::metadata(root).map_err(io)?;
    let mut sequences = match dataset {
        Dataset::KittiImuGps => drive(root),
        Dataset::Broad => trials(root)?,
        Dataset::Sim => Vec::new(),
        _ => recordings(dataset, root)?,
    };
    let known = dataset.sequences();
    let rank = |name: &str| known.iter().position(|known| *known == name).unwrap_or(known.len());
    sequences.sort_by(|a, b| (rank(&a.name), &a.name).cmp(&(rank(&b.name), &b.name)));
    // The same recording unpacked and as a bag: folders, which know more, come first by path.
    sequences.dedup_by(|a, b| a.name == b.name);
    if sequences.is_empty() {
        let (dataset, expected) = (dataset.name(), dataset.expected());
        return Err(BenchError::NothingFound { dataset, root: root.to_owned(), expected });
    }
    let is_there = |name: &&&str| !sequences.iter().any(|sequence| sequence.name == **name);
    let missing = known.iter().filter(is_there).map(|name| (*name).to_owned()).collect();
    Ok(Found { sequences, missing })
}

/// Logs with images.
fn recordings(dataset: Dataset, root: &Path) -> Result<Vec<Sequence>, BenchError> {
    let mut tree = Tree::default();
    tree.walk(root, DEPTH, &|path| is_log_folder(dataset, path))?;
    let has_bags =
        matches!(dataset, Dataset::Euroc | Dataset::EurocMono | Dataset::TumVi | Dataset::VcuRvi);
    let bags = tree.files.iter().filter(|path| has_bags && is_message_log(path));
    let logs = tree.logs.iter().chain(bags);
    Ok(logs.map(|log| recording(dataset, root, log, &tree.files)).collect())
}

fn recording(dataset: Dataset, root: &Path, log: &Path, files: &[PathBuf]) -> Sequence {
    let name = name_of(dataset, root, log);
    let truth = match dataset {
        // Their readers know the truth file of a folder.
        Dataset::Openloris | Dataset::TumRgbd | Dataset::SevenScenes => None,
        Dataset::TumVi if log.is_dir() => mocap(log),
        Dataset::Euroc | Dataset::EurocMono if log.is_dir() => None,
        _ => truth_file(dataset, &name, log, files),
    };
    let clock = if dataset == Dataset::VcuRvi { Clock::Apart } else { Clock::Shared };
    Sequence {
        source: Source::Log { log: log.to_owned(), truth },
        clock,
        one_camera: dataset == Dataset::EurocMono,
        settings: settings(dataset, &name),
        disturbed: disturbed(dataset, &name),
        name,
    }
}

fn is_message_log(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    MESSAGE_LOGS.iter().any(|ending| name.ends_with(ending))
}

/// Whether a folder is a log of this data set.
fn is_log_folder(dataset: Dataset, path: &Path) -> bool {
    let holds = |name: &str| path.join(name).exists();
    match dataset {
        Dataset::Euroc | Dataset::EurocMono | Dataset::TumVi => {
            path.join("mav0").is_dir() || path.ends_with("mav0") || holds("metadata.yaml")
        }
        Dataset::VcuRvi => holds("metadata.yaml"),
        Dataset::Openloris => holds("color.txt") && holds("sensors.yaml"),
        Dataset::TumRgbd => holds("rgb.txt"),
        Dataset::SevenScenes => holds("frame-000000.color.png") || holds("frame-000000.color.jpg"),
        Dataset::Broad | Dataset::KittiImuGps | Dataset::Sim => false,
    }
}

/// Folders that are logs, and files elsewhere.
#[derive(Default)]
struct Tree {
    logs: Vec<PathBuf>,
    files: Vec<PathBuf>,
}

impl Tree {
    fn walk(
        &mut self,
        folder: &Path,
        depth: usize,
        is_log: &dyn Fn(&Path) -> bool,
    ) -> Result<(), BenchError> {
        if folder.is_file() {
            self.files.push(folder.to_owned());
            return Ok(());
        }
        if is_log(folder) {
            self.logs.push(folder.to_owned());
            return Ok(());
        }
        for path in entries(folder)? {
            if path.is_dir() {
                if depth > 0 {
                    self.walk(&path, depth - 1, is_log)?;
                }
            } else {
                self.files.push(path);
            }
        }
        Ok(())
    }
}

/// What lies in a folder, sorted, without hidden files.
fn entries(folder: &Path) -> Result<Vec<PathBuf>, BenchError> {
    let io = |source| BenchError::Io { path: folder.to_owned(), source };
    let mut paths = std::fs::read_dir(folder)
        .map_err(io)?
        .map(|entry| entry.map(|entry| entry.path()).map_err(io))
        .collect::<Result<Vec<_>, _>>()?;
    let hidden =
        |path: &Path| path.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
    paths.retain(|path| !hidden(path));
    paths.sort();
    Ok(paths)
}

/// The data set's own name of a recording where it has one, else that of its file or folder.
fn name_of(dataset: Dataset, root: &Path, log: &Path) -> String {
    let resolved = log.canonicalize().unwrap_or_else(|_| log.to_owned());
    let part = if resolved.ends_with("mav0") { resolved.parent() } else { None };
    let named = part.unwrap_or(&resolved);
    let own = stem(named);
    let known = dataset.sequences();
    if let Some(known) = known.iter().find(|known| same_sequence(dataset, known, &own)) {
        return (*known).to_owned();
    }
    // A scene of 7-Scenes has many folders `seq-01`.
    let scene = named.parent().filter(|_| dataset == Dataset::SevenScenes && log != root);
    match scene.map(stem).filter(|scene| !scene.is_empty()) {
        Some(scene) => format!("{scene}-{own}"),
        None => own,
    }
}

/// File name up to its first ending that is one of a log or table.
fn stem(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let endings = MESSAGE_LOGS.iter().chain(&[".csv", ".txt", ".tum"]);
    let ending = endings.into_iter().find(|ending| name.to_lowercase().ends_with(**ending));
    let length = name.len() - ending.map_or(0, |ending| ending.len());
    name[..length].to_owned()
}

/// Lower-case letters and digits only.
fn plain(text: &str) -> String {
    text.to_lowercase().chars().filter(char::is_ascii_alphanumeric).collect()
}

/// Whether a file or folder called `name` is the sequence `known`.
pub(super) fn same_sequence(dataset: Dataset, known: &str, name: &str) -> bool {
    let (known_plain, name) = (plain(known), plain(name));
    match dataset {
        // `V1_01`, `V1_01_easy`, `MH_01_easy_512`.
        Dataset::Euroc | Dataset::EurocMono => {
            let short: Vec<&str> = known.split('_').take(2).collect();
            name == plain(&short.concat()) || name.starts_with(&known_plain)
        }
        // `dataset-room1_512_16`, `dataset-room1_1024_16`, `room1`.
        Dataset::TumVi => {
            let name = name.strip_prefix("dataset").unwrap_or(&name);
            let rest = name.strip_prefix(known_plain.as_str());
            rest.is_some_and(|rest| ["", "51216", "102416"].contains(&rest))
        }
        // The authors also write `lab-easy`, `robot-lab` and `bumper-lab`.
        Dataset::VcuRvi => {
            let name = name
                .replace("labeasy", "labsimple")
                .replace("robotlab", "labmanual")
                .replace("bumperlab", "labbumper");
            name == known_plain || format!("lab{name}") == known_plain
        }
        _ => name == known_plain,
    }
}

/// The truth of a TUM-VI folder, which lies beside the sensors' folders.
fn mocap(log: &Path) -> Option<PathBuf> {
    let root = if log.ends_with("mav0") { log.to_owned() } else { log.join("mav0") };
    let candidates =
        [root.join("mocap0").join("data.csv"), root.join("../dso/gt_imu.csv"), root.join("gt.csv")];
    candidates.into_iter().find(|path| path.is_file())
}

/// The truth file of a bag: the one of the same name, whatever its folder and ending.
fn truth_file(dataset: Dataset, name: &str, log: &Path, files: &[PathBuf]) -> Option<PathBuf> {
    let is_table = |path: &&PathBuf| {
        let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        ["csv", "txt", "tum"].contains(&ending.as_str())
    };
    let own = stem(log);
    files
        .iter()
        .filter(is_table)
        .find(|path| {
            let stem = stem(path);
            let bare = ["_groundtruth", "_ground_truth", "_truth", "_gt", "-gt"]
                .iter()
                .find_map(|ending| stem.strip_suffix(ending))
                .unwrap_or(&stem);
            plain(bare) == plain(&own) || same_sequence(dataset, name, bare)
        })
        .cloned()
}

/// What a recording needs beyond the configuration of its layout.
fn settings(dataset: Dataset, name: &str) -> Vec<String> {
    let lines: &[&str] = match dataset {
        Dataset::EurocMono => &["log.right_topic=none"],
        Dataset::TumRgbd => tum_camera(name),
        _ => &[],
    };
    lines.iter().map(|line| (*line).to_owned()).collect()
}

/// The three cameras of TUM RGB-D, as its authors calibrated them:
/// <https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats>.
fn tum_camera(name: &str) -> &'static [&'static str] {
    let name = plain(name);
    let is = |number: char| {
        name.contains(&format!("freiburg{number}")) || name.contains(&format!("fr{number}"))
    };
    match () {
        () if is('2') => &[
            "camera.fx=520.9",
            "camera.fy=521.0",
            "camera.cx=325.1",
            "camera.cy=249.7",
            "camera.distortion=[0.2312, -0.7849, -0.0033, -0.0001, 0.9172]",
        ],
        () if is('3') => &[
            "camera.fx=535.4",
            "camera.fy=539.2",
            "camera.cx=320.1",
            "camera.cy=247.6",
            "camera.distortion=[0.0, 0.0, 0.0, 0.0, 0.0]",
        ],
        // The configuration's camera is that of freiburg1.
        () => &[],
    }
}

/// Recordings in which something is meant to go wrong all the time.
fn disturbed(dataset: Dataset, name: &str) -> Vec<[f64; 2]> {
    let expected = dataset == Dataset::VcuRvi
        && (name.starts_with("lab_light") || name.starts_with("lab_dynamic"));
    if expected { vec![[0.0, f64::INFINITY]] } else { Vec::new() }
}

/// The KITTI drive of GTSAM's examples.
fn drive(root: &Path) -> Vec<Sequence> {
    let [imu, gps] = ["KittiEquivBiasedImu.txt", "KittiGps_converted.txt"].map(|n| root.join(n));
    let complete = imu.is_file() && gps.is_file();
    let source = Source::Navigation { imu, gps };
    let drive = || sequence("drive".to_owned(), source);
    complete.then(drive).into_iter().collect()
}

/// Trials of BROAD as tables.
fn trials(root: &Path) -> Result<Vec<Sequence>, BenchError> {
    let folders = std::iter::once(root.to_owned()).chain(entries(root)?);
    let trial = |folder: PathBuf| {
        let [imu, reference] = ["imu.csv", "reference.csv"].map(|name| folder.join(name));
        let complete = imu.is_file() && reference.is_file();
        complete.then(|| sequence(stem(&folder), Source::Attitude { imu, reference }))
    };
    Ok(folders.filter_map(trial).collect())
}

fn sequence(name: String, source: Source) -> Sequence {
    Sequence {
        name,
        source,
        clock: Clock::Shared,
        one_camera: false,
        settings: Vec::new(),
        disturbed: Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn touch(root: &Path, files: &[&str]) {
        for file in files {
            let path = root.join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        }
    }

    fn names(found: &Found) -> Vec<&str> {
        found.sequences.iter().map(|sequence| sequence.name.as_str()).collect()
    }

    fn truth(found: &Found, index: usize) -> Option<String> {
        match &found.sequences[index].source {
            Source::Log { truth, .. } => {
                truth.as_deref().map(|path| path.file_name().unwrap().to_string_lossy().into())
            }
            _ => None,
        }
    }

    #[test]
    fn euroc_is_found_unpacked_and_as_bags() {
        let root = tempfile::tempdir().unwrap();
        touch(
            root.path(),
            &[
                "machine_hall/MH_01_easy/mav0/cam0/sensor.yaml",
                "vicon_room1/V1_02_medium/V1_02_medium.bag",
                "truth/V1_02_medium.csv",
                "V2_01_easy/mav0/cam0/sensor.yaml",
                "own_flight/mav0/cam0/sensor.yaml",
            ],
        );
        let found = find(Dataset::Euroc, root.path()).unwrap();
        assert_eq!(names(&found), ["MH_01_easy", "V1_02_medium", "V2_01_easy", "own_flight"]);
        assert_eq!(truth(&found, 1).as_deref(), Some("V1_02_medium.csv"));
        assert_eq!(found.missing.len(), 8);
        let mono = find(Dataset::EurocMono, &root.path().join("V2_01_easy")).unwrap();
        assert_eq!(names(&mono), ["V2_01_easy"]);
        assert_eq!(mono.sequences[0].settings, ["log.right_topic=none"]);
    }

    #[test]
    fn vcu_rvi_takes_truth_of_the_same_sequence() {
        let root = tempfile::tempdir().unwrap();
        touch(
            root.path(),
            &[
                "lab_bumper1.bag",
                "bags/lab-easy2.bag",
                "corridor_bumper1.bag",
                "ground_truths/lab_bumper1_gt.csv",
                "ground_truths/lab_simple2_gt.csv",
                "ground_truths/lab_bumper10_gt.csv",
                "ground_truths/corridor1_gt.csv",
            ],
        );
        let found = find(Dataset::VcuRvi, root.path()).unwrap();
        assert_eq!(names(&found), ["lab_simple2", "lab_bumper1", "corridor_bumper1"]);
        assert_eq!(truth(&found, 0).as_deref(), Some("lab_simple2_gt.csv"));
        assert_eq!(truth(&found, 1).as_deref(), Some("lab_bumper1_gt.csv"));
        assert_eq!(truth(&found, 2), None);
        assert_eq!(found.sequences[0].clock, Clock::Apart);
    }

    #[test]
    fn other_layouts_are_found() {
        let root = tempfile::tempdir().unwrap();
        let cases: [(Dataset, &[&str], &[&str]); 6] = [
            (
                Dataset::TumVi,
                &["dataset-room1_512_16/mav0/mocap0/data.csv", "dataset-room10_x/mav0/a"],
                &["room1", "dataset-room10_x"],
            ),
            (
                Dataset::Openloris,
                &["office1-1/color.txt", "office1-1/sensors.yaml"],
                &["office1-1"],
            ),
            (
                Dataset::TumRgbd,
                &["rgbd_dataset_freiburg2_desk/rgb.txt"],
                &["rgbd_dataset_freiburg2_desk"],
            ),
            (Dataset::SevenScenes, &["chess/seq-01/frame-000000.color.png"], &["chess-seq-01"]),
            (Dataset::Broad, &["01_slow/imu.csv", "01_slow/reference.csv"], &["01_slow"]),
            (
                Dataset::KittiImuGps,
                &["KittiEquivBiasedImu.txt", "KittiGps_converted.txt"],
                &["drive"],
            ),
        ];
        for (dataset, files, expected) in cases {
            let folder = root.path().join(dataset.name());
            touch(&folder, files);
            let found = find(dataset, &folder).unwrap();
            assert_eq!(names(&found), expected, "{dataset}");
        }
        let room = find(Dataset::TumVi, &root.path().join("tum-vi")).unwrap();
        assert_eq!(truth(&room, 0).as_deref(), Some("data.csv"));
        let desk = find(Dataset::TumRgbd, &root.path().join("tum-rgbd")).unwrap();
        assert!(desk.sequences[0].settings.contains(&"camera.fx=520.9".to_owned()));
    }

    #[test]
    fn an_empty_folder_says_what_was_expected() {
        let root = tempfile::tempdir().unwrap();
        let error = find(Dataset::Openloris, root.path()).unwrap_err().to_string();
        assert!(error.contains("sensors.yaml") && error.contains("datasets/openloris.md"));
        assert!(find(Dataset::Euroc, Path::new("/nonexistent")).is_err());
    }
}
