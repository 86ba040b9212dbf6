//! Runs that are done, one file each.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::error::BenchError;
use super::figures::NeesMeans;
use super::key::RunKey;

/// A finished run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    pub key: RunKey,
    pub outcome: Outcome,
    /// Apart from the outcome, which is the same whenever the run is made again.
    pub times: Times,
}

/// The figures of a run, which depend on its key alone.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// Why there are no figures, or only some.
    pub failure: Option<String>,
    /// How the estimate began.
    pub initialization: Option<String>,
    pub frames: u64,
    /// Poses that were compared with the truth.
    pub matched: usize,
    /// Share of the truth's duration with an estimate.
    pub coverage: f64,
    /// Position RMSE after SE(3) alignment, m.
    pub ape_m: Option<f64>,
    /// Attitude RMSE after SE(3) alignment, degrees.
    pub attitude_deg: Option<f64>,
    /// Position RMSE of the motion over 1 s, m.
    pub rpe_1s_m: Option<f64>,
    pub nees: Option<NeesMeans>,
    /// Added to the estimate's stamps to bring them to the truth's clock, s.
    pub clock_offset: Option<f64>,
    /// Warnings where nothing was wrong.
    pub false_alarms: u64,
    /// What the run warned of, once each.
    pub faults: Vec<String>,
    /// Injected faults that no warning named.
    pub faults_missed: Vec<String>,
}

/// What a run took.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Times {
    /// Processor time, reading included, over the frames; ms.
    pub cpu_ms_per_frame: Option<f64>,
    pub wall_seconds: f64,
}

/// A folder of finished runs.
#[derive(Debug, Clone)]
pub struct Store {
    folder: PathBuf,
}

impl Store {
    /// Creates `folder` where it is absent.
    ///
    /// # Errors
    /// [`BenchError::Io`] if it cannot be made.
    pub fn open(folder: &Path) -> Result<Self, BenchError> {
        std::fs::create_dir_all(folder)
            .map_err(|source| BenchError::Io { path: folder.to_owned(), source })?;
        Ok(Self { folder: folder.to_owned() })
    }

    fn file(&self, key: &RunKey) -> Result<PathBuf, BenchError> {
        Ok(self.folder.join(format!("{}.json", key.digest()?)))
    }

    /// The run of this key, if it is done. A file that holds another run, or none, is no error:
    /// the run is made again.
    ///
    /// # Errors
    /// [`BenchError::Io`] if there is a file that cannot be read.
    pub fn get(&self, key: &RunKey) -> Result<Option<RunRecord>, BenchError> {
        let path = self.file(key)?;
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(BenchError::Io { path, source }),
        };
        let record: Option<RunRecord> = serde_json::from_str(&text).ok();
        Ok(record.filter(|record| record.key == *key))
    }

    /// Keeps a run and returns it as it will be read: the last digit of a number in text may
    /// differ, and figures must not depend on whether a run was made or found.
    ///
    /// # Errors
    /// [`BenchError::Io`] if it cannot be written; what was there before is then untouched.
    pub fn put(&self, record: &RunRecord) -> Result<RunRecord, BenchError> {
        let path = self.file(&record.key)?;
        let text = serde_json::to_string_pretty(record)
            .map_err(|e| BenchError::Format { path: path.clone(), reason: e.to_string() })?;
        let io = |source| BenchError::Io { path: path.clone(), source };
        // Complete or not at all, also where two programs write the same run.
        let part = path.with_extension(format!("{}.part", std::process::id()));
        std::fs::write(&part, text + "\n").map_err(io)?;
        std::fs::rename(&part, &path).map_err(io)?;
        let kept = self.get(&record.key)?;
        kept.ok_or_else(|| BenchError::Format {
            path,
            reason: "is not what was written".to_owned(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(seed: u64) -> RunKey {
        RunKey {
            program: "p".to_owned(),
            dataset: "sim".to_owned(),
            sequence: "lab-simple".to_owned(),
            input: "i".to_owned(),
            filter: "mfgs".to_owned(),
            seed,
            init: None,
            config: None,
            settings: vec!["imu.gyro_noise=1e-3".to_owned()],
            faults: Vec::new(),
            duration: Some(0.1 + 0.2),
        }
    }

    #[test]
    fn a_run_is_found_by_what_it_is_made_of() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(&folder.path().join("runs")).unwrap();
        let outcome = Outcome { ape_m: Some(1.0 / 3.0), frames: 7, ..Outcome::default() };
        let record = RunRecord { key: key(1), outcome, times: Times::default() };
        assert_eq!(store.get(&key(1)).unwrap(), None);
        let kept = store.put(&record).unwrap();
        assert_eq!(store.get(&key(1)).unwrap(), Some(kept));
        assert_eq!(store.get(&key(2)).unwrap(), None);
        let other = RunKey { program: "q".to_owned(), ..key(1) };
        assert_eq!(store.get(&other).unwrap(), None);
    }

    #[test]
    fn a_damaged_record_is_made_again() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).unwrap();
        let record =
            RunRecord { key: key(1), outcome: Outcome::default(), times: Times::default() };
        store.put(&record).unwrap();
        let path = store.file(&key(1)).unwrap();
        std::fs::write(&path, "{\"key\":").unwrap();
        assert_eq!(store.get(&key(1)).unwrap(), None);
        store.put(&record).unwrap();
        assert!(store.get(&key(1)).unwrap().is_some());
    }
}
