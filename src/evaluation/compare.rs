use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{EvaluationError, Statistics, paired_t_test};

/// What a finished run says of itself in its `metrics.json`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
struct Metrics {
    #[serde(default)]
    path_length: Option<f64>,
    #[serde(default)]
    real_time_factor: Option<f64>,
    #[serde(default)]
    evaluation: Option<MetricsEvaluation>,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
struct MetricsEvaluation {
    matched: usize,
    ape_translation: Statistics,
    ape_rotation_deg: Statistics,
}

/// One run of a method.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Run {
    /// Name of its directory: the sequence where a method has many.
    pub name: String,
    pub directory: PathBuf,
    /// Whether it came to its end and wrote its metrics.
    pub finished: bool,
    /// The rest is `None` where the run has no evaluation (no reference, or it failed).
    pub matched: Option<usize>,
    /// RMSE of the absolute position error, m.
    pub position_rmse: Option<f64>,
    /// RMSE of the absolute attitude error, degrees.
    pub attitude_rmse: Option<f64>,
    /// Position RMSE as a percentage of the length of the estimated path.
    pub drift_percent: Option<f64>,
    pub real_time_factor: Option<f64>,
}

/// The runs of one directory.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Method {
    pub name: String,
    pub runs: Vec<Run>,
    /// Mean of the runs' position RMSE over those that have one, m.
    pub mean_position_rmse: Option<f64>,
    pub mean_attitude_rmse: Option<f64>,
    pub mean_drift_percent: Option<f64>,
    /// Fraction of the runs whose position RMSE is at most the limit.
    pub success_rate: f64,
}

/// Paired t-test of the position RMSE of two methods on the runs that both have.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PairedTest {
    pub first: String,
    pub second: String,
    /// Runs of the same name.
    pub runs: usize,
    /// Mean of first minus second, m.
    pub mean_difference: f64,
    /// Two-sided; `None` for fewer than two runs or differences that are all equal.
    pub p_value: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    pub methods: Vec<Method>,
    pub tests: Vec<PairedTest>,
}

/// Puts the runs of several directories side by side.
///
/// A directory is a run if it holds `metrics.json` or what a run writes before that, else a method whose sub-directories are runs.
/// `success_limit` is the largest position RMSE of a success, m.
pub fn compare(directories: &[PathBuf], success_limit: f64) -> Result<Comparison, EvaluationError> {
    let methods = directories
        .iter()
        .map(|directory| Method::read(directory, success_limit))
        .collect::<Result<Vec<_>, _>>()?;
    let mut tests = Vec::new();
    for (index, first) in methods.iter().enumerate() {
        tests.extend(methods[index + 1..].iter().filter_map(|second| paired_test(first, second)));
    }
    Ok(Comparison { methods, tests })
}

const METRICS: &str = "metrics.json";
/// What a run that failed or was ended leaves.
const UNFINISHED: [&str; 2] = ["trajectory.tum", "state.csv"];

fn is_run(directory: &Path) -> bool {
    [METRICS].iter().chain(&UNFINISHED).any(|name| directory.join(name).is_file())
}

impl Method {
    fn read(directory: &Path, success_limit: f64) -> Result<Self, EvaluationError> {
        let runs = if is_run(directory) {
            vec![Run::read(directory)?]
        } else {
            let io = |error| EvaluationError::Io { path: directory.to_owned(), error };
            let mut directories = Vec::new();
            for entry in std::fs::read_dir(directory).map_err(io)? {
                let path = entry.map_err(io)?.path();
                if is_run(&path) {
                    directories.push(path);
                }
            }
            directories.sort();
            directories.iter().map(|path| Run::read(path)).collect::<Result<Vec<_>, _>>()?
        };
        if runs.is_empty() {
            return Err(EvaluationError::Format {
                path: directory.to_owned(),
                reason: format!("neither holds {METRICS} nor a directory that does"),
            });
        }
        let mean = |value: &dyn Fn(&Run) -> Option<f64>| {
            let values: Vec<f64> = runs.iter().filter_map(value).collect();
            Statistics::of(&values).map(|s| s.mean)
        };
        let success = |run: &&Run| run.position_rmse.is_some_and(|rmse| rmse <= success_limit);
        Ok(Self {
            name: name_of(directory),
            mean_position_rmse: mean(&|run| run.position_rmse),
            mean_attitude_rmse: mean(&|run| run.attitude_rmse),
            mean_drift_percent: mean(&|run| run.drift_percent),
            success_rate: runs.iter().filter(success).count() as f64 / runs.len() as f64,
            runs,
        })
    }
}

impl Run {
    fn read(directory: &Path) -> Result<Self, EvaluationError> {
        let path = directory.join(METRICS);
        let finished = path.is_file();
        if !finished {
            return Ok(Self {
                name: name_of(directory),
                directory: directory.to_owned(),
                ..Self::default()
            });
        }
        let text = std::fs::read_to_string(&path)
            .map_err(|error| EvaluationError::Io { path: path.clone(), error })?;
        let metrics: Metrics = serde_json::from_str(&text)
            .map_err(|e| EvaluationError::Format { path, reason: e.to_string() })?;
        let evaluation = metrics.evaluation.as_ref();
        let position_rmse = evaluation.map(|e| e.ape_translation.rmse);
        let drift = |rmse: f64| {
            let length = metrics.path_length.filter(|length| *length > 0.0)?;
            Some(100.0 * rmse / length)
        };
        Ok(Self {
            name: name_of(directory),
            directory: directory.to_owned(),
            finished,
            matched: evaluation.map(|e| e.matched),
            position_rmse,
            attitude_rmse: evaluation.map(|e| e.ape_rotation_deg.rmse),
            drift_percent: position_rmse.and_then(drift),
            real_time_factor: metrics.real_time_factor,
        })
    }
}

/// Last part of the path, for `.` and `..` that of what they stand for.
fn name_of(directory: &Path) -> String {
    let resolved = directory.canonicalize();
    let path = resolved.as_deref().unwrap_or(directory);
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// `None` where the methods have no run in common.
fn paired_test(first: &Method, second: &Method) -> Option<PairedTest> {
    let errors = |method: &Method| -> BTreeMap<String, f64> {
        method.runs.iter().filter_map(|run| Some((run.name.clone(), run.position_rmse?))).collect()
    };
    let others = errors(second);
    let differences: Vec<f64> =
        errors(first).iter().filter_map(|(name, rmse)| Some(rmse - others.get(name)?)).collect();
    let statistics = Statistics::of(&differences)?;
    Some(PairedTest {
        first: first.name.clone(),
        second: second.name.clone(),
        runs: differences.len(),
        mean_difference: statistics.mean,
        p_value: paired_t_test(&differences),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    fn write_run(directory: &Path, rmse: Option<f64>) {
        std::fs::create_dir_all(directory).unwrap();
        let statistics = |rmse: f64| Statistics::of(&[rmse]).unwrap();
        let evaluation = rmse.map(|rmse| {
            serde_json::json!({
                "matched": 10,
                "reference_poses": 100,
                "ape_translation": statistics(rmse),
                "ape_rotation_deg": statistics(10.0 * rmse),
            })
        });
        let metrics = serde_json::json!({
            "path_length": 20.0, "evaluation": evaluation, "filter": "mfgr",
        });
        std::fs::write(directory.join("metrics.json"), metrics.to_string()).unwrap();
    }

    #[test]
    fn methods_are_compared_on_the_runs_they_share() {
        let root = tempfile::tempdir().unwrap();
        let [a, b] = ["a", "b"].map(|name| root.path().join(name));
        for (run, x, y) in
            [("1", 0.30, 0.35), ("2", 0.20, 0.26), ("3", 0.40, 0.43), ("4", 0.1, 0.15)]
        {
            write_run(&a.join(run), Some(x));
            write_run(&b.join(run), Some(y));
        }
        write_run(&a.join("5"), None);
        let comparison = compare(&[a, b], 0.35).unwrap();
        let [a, b] = &comparison.methods[..] else { panic!("two methods") };
        assert_relative_eq!(a.mean_position_rmse.unwrap(), 0.25, epsilon = 1e-12);
        assert_relative_eq!(b.mean_attitude_rmse.unwrap(), 2.975, epsilon = 1e-12);
        assert_relative_eq!(a.mean_drift_percent.unwrap(), 1.25, epsilon = 1e-12);
        assert_eq!((a.success_rate, b.success_rate), (0.6, 0.75));
        let test = &comparison.tests[0];
        assert_eq!((test.runs, comparison.tests.len()), (4, 1));
        assert_relative_eq!(test.mean_difference, -0.0475, epsilon = 1e-12);
        // scipy.stats.ttest_rel of the same numbers.
        assert_relative_eq!(test.p_value.unwrap(), 0.0048182304681985665, epsilon = 1e-9);
    }

    #[test]
    fn a_directory_without_runs_is_refused() {
        let root = tempfile::tempdir().unwrap();
        let error = compare(&[root.path().to_owned()], 1.0).unwrap_err().to_string();
        assert!(error.contains("metrics.json"), "{error}");
        write_run(root.path(), Some(0.5));
        assert_eq!(compare(&[root.path().to_owned()], 1.0).unwrap().methods[0].runs.len(), 1);
    }
}
