//! What a bench consists of: every sequence with every start, filter, setting and seed.

use std::path::PathBuf;
use std::str::FromStr;

use super::dataset::{Clock, Dataset, Sequence, Source};
use super::discovery::{find, same_sequence};
use super::error::BenchError;
use super::recipe::{RECIPES, Sensors};
use crate::config::Config;
use crate::evaluation::read_trajectory;
use crate::odometry::InitMode;

/// What a bench is asked for.
#[derive(Debug, Clone)]
pub struct BenchRequest {
    pub dataset: Dataset,
    /// Folder of the recordings; for `sim` of trajectories to move along, if any.
    pub root: Option<PathBuf>,
    /// Only these; empty: all.
    pub sequences: Vec<String>,
    /// Empty: the data set's default filter.
    pub filters: Vec<String>,
    /// Empty: as the configuration says.
    pub inits: Vec<InitMode>,
    /// `None`: three, of recorded data with `quick` one.
    pub seeds: Option<u64>,
    /// Settings to vary.
    pub sweep: Vec<Axis>,
    /// `SECTION.KEY=VALUE` of all runs.
    pub settings: Vec<String>,
    pub config: Option<PathBuf>,
    /// Part of each log that is used, or length of each that is rendered, s.
    pub duration: Option<f64>,
    /// A short look: the beginning of each recording; of `sim` the recipes of the regression guard.
    pub quick: bool,
}

/// A setting with the values that it takes, written `SECTION.KEY=VALUE,VALUE`.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    pub key: String,
    pub values: Vec<String>,
}

/// One run.
#[derive(Debug, Clone)]
pub struct PlannedRun {
    pub sequence: Sequence,
    pub filter: String,
    pub init: Option<InitMode>,
    /// Keys and values of the sweep.
    pub swept: Vec<(String, String)>,
    pub seed: u64,
    /// `SECTION.KEY=VALUE` in the order in which they apply.
    pub settings: Vec<String>,
    /// s.
    pub duration: Option<f64>,
}

/// The runs in the order of the table.
#[derive(Debug, Clone)]
pub struct Plan {
    pub dataset: Dataset,
    pub runs: Vec<PlannedRun>,
    /// Sequences of the data set that are not there.
    pub missing: Vec<String>,
    /// Configuration file and its text, where one was given.
    pub config: Option<(PathBuf, String)>,
}

/// Seeds where none are asked for.
const SEEDS: u64 = 3;
/// Part of a recording that a short look takes, s: enough for EuRoC's late truth.
const QUICK_RECORDED: f64 = 20.0;
/// Length of a simulated log, s.
const SIMULATED: f64 = 30.0;
/// ... and of one for a short look.
const QUICK_SIMULATED: f64 = 8.0;

/// Finds what there is to run.
///
/// # Errors
/// If nothing is found, or something was asked for that does not exist; nothing has been run then.
pub fn plan(request: &BenchRequest) -> Result<Plan, BenchError> {
    let dataset = request.dataset;
    let config = request.config.as_deref().map(|path| {
        let text = std::fs::read_to_string(path)
            .map_err(|source| BenchError::Io { path: path.to_owned(), source })?;
        Ok::<_, BenchError>((path.to_owned(), text))
    });
    let config = config.transpose()?;
    check_settings(request)?;
    let filters = filters(request)?;
    let (sequences, missing) = sequences(request)?;
    let seeds = request.seeds.unwrap_or(match request.quick && dataset != Dataset::Sim {
        true => 1,
        false => SEEDS,
    });
    let inits: Vec<Option<InitMode>> = match request.inits.is_empty() {
        true => vec![None],
        false => request.inits.iter().copied().map(Some).collect(),
    };
    let grid = grid(&request.sweep);
    let mut runs = Vec::new();
    for sequence in &sequences {
        for init in &inits {
            for filter in &filters {
                for swept in &grid {
                    let settings = settings(request, sequence, swept);
                    runs.extend((1..=seeds).map(|seed| PlannedRun {
                        sequence: sequence.clone(),
                        filter: filter.clone(),
                        init: *init,
                        swept: swept.clone(),
                        seed,
                        settings: settings.clone(),
                        duration: duration(request),
                    }));
                }
            }
        }
    }
    Ok(Plan { dataset, runs, missing, config })
}

impl PlannedRun {
    /// Whether two runs differ by their seed only.
    pub fn is_seed_of(&self, other: &Self) -> bool {
        (&self.sequence.name, &self.filter, self.init, &self.swept)
            == (&other.sequence.name, &other.filter, other.init, &other.swept)
    }

    /// For people: `lab-simple, mfgs, seed 2`.
    pub fn label(&self) -> String {
        let swept: String = self.swept.iter().map(|(k, v)| format!(", {k}={v}")).collect();
        let init = self.init.map_or_else(String::new, |mode| format!(", {mode}"));
        format!("{}, {}{init}{swept}, seed {}", self.sequence.name, self.filter, self.seed)
    }
}

impl FromStr for Axis {
    type Err = BenchError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let malformed = || BenchError::Sweep { text: text.to_owned() };
        let (key, list) = text.split_once('=').ok_or_else(malformed)?;
        let values = split_values(list);
        let is_complete = !values.is_empty() && values.iter().all(|value| !value.is_empty());
        if !is_complete || !key.trim().contains('.') {
            return Err(malformed());
        }
        Ok(Self { key: key.trim().to_owned(), values })
    }
}

/// At commas outside brackets and quotes, since a value may be a list.
fn split_values(list: &str) -> Vec<String> {
    let mut values = vec![String::new()];
    let (mut depth, mut quoted) = (0_i32, false);
    for c in list.chars() {
        match c {
            '[' if !quoted => depth += 1,
            ']' if !quoted => depth -= 1,
            '"' => quoted = !quoted,
            _ => {}
        }
        match (c, values.last_mut()) {
            (',', _) if depth == 0 && !quoted => values.push(String::new()),
            (c, Some(value)) => value.push(c),
            (_, None) => {}
        }
    }
    values.iter().map(|value| value.trim().to_owned()).collect()
}

/// Every combination of the axes' values; one empty combination where there are no axes.
fn grid(axes: &[Axis]) -> Vec<Vec<(String, String)>> {
    axes.iter().fold(vec![Vec::new()], |grid, axis| {
        let extended = |point: &Vec<(String, String)>| {
            let value = |value: &String| {
                let with = (axis.key.clone(), value.clone());
                point.iter().cloned().chain([with]).collect()
            };
            axis.values.iter().map(value).collect::<Vec<Vec<_>>>()
        };
        grid.iter().flat_map(extended).collect()
    })
}

/// A wrong key or value is refused before anything is run.
fn check_settings(request: &BenchRequest) -> Result<(), BenchError> {
    for point in grid(&request.sweep) {
        let swept = point.iter().map(|(key, value)| format!("{key}={value}"));
        let settings: Vec<String> = request.settings.iter().cloned().chain(swept).collect();
        match request.dataset {
            Dataset::KittiImuGps => {
                crate::filter::gnss::GnssConfig::shipped("kitti", &settings)?;
            }
            Dataset::Broad => {
                if let Some(setting) = settings.first() {
                    return Err(BenchError::Sweep { text: setting.clone() });
                }
            }
            _ => {
                Config::shipped("sim", &settings)?;
            }
        }
    }
    Ok(())
}

fn filters(request: &BenchRequest) -> Result<Vec<String>, BenchError> {
    let available = request.dataset.filters();
    let known = |name: &String| match available.contains(&name.as_str()) {
        true => Ok(name.clone()),
        false => Err(BenchError::UnknownFilter {
            dataset: request.dataset.name(),
            name: name.clone(),
            available: available.join(", "),
        }),
    };
    let mut filters =
        request.filters.iter().map(known).collect::<Result<Vec<String>, BenchError>>()?;
    if filters.is_empty() {
        filters.extend(available.first().map(|name| (*name).to_owned()));
    }
    Ok(filters)
}

fn settings(
    request: &BenchRequest,
    sequence: &Sequence,
    swept: &[(String, String)],
) -> Vec<String> {
    let swept = swept.iter().map(|(key, value)| format!("{key}={value}"));
    sequence.settings.iter().chain(&request.settings).cloned().chain(swept).collect()
}

fn duration(request: &BenchRequest) -> Option<f64> {
    request.duration.or(match (request.dataset, request.quick) {
        (Dataset::Sim, true) => Some(QUICK_SIMULATED),
        (Dataset::Sim, false) => Some(SIMULATED),
        (_, true) => Some(QUICK_RECORDED),
        (_, false) => None,
    })
}

/// The sequences asked for and those of the data set that are not there.
fn sequences(request: &BenchRequest) -> Result<(Vec<Sequence>, Vec<String>), BenchError> {
    let dataset = request.dataset;
    let (found, missing) = match (dataset, &request.root) {
        (Dataset::Sim, root) => (simulated(root.as_ref(), request)?, Vec::new()),
        (_, None) => return Err(BenchError::NoRoot { dataset: dataset.name() }),
        (_, Some(root)) => {
            let found = find(dataset, root)?;
            (found.sequences, found.missing)
        }
    };
    if request.sequences.is_empty() {
        return Ok((found, missing));
    }
    let mut chosen = Vec::new();
    for name in &request.sequences {
        let is_named = |s: &&Sequence| s.name == *name || same_sequence(dataset, &s.name, name);
        match found.iter().find(is_named) {
            Some(sequence) => chosen.push(sequence.clone()),
            None => return Err(not_there(request, name, &found)),
        }
    }
    Ok((chosen, Vec::new()))
}

fn not_there(request: &BenchRequest, name: &str, found: &[Sequence]) -> BenchError {
    let dataset = request.dataset;
    let is_known = dataset.sequences().iter().any(|known| same_sequence(dataset, known, name));
    match &request.root {
        Some(root) if is_known && dataset != Dataset::Sim => BenchError::Absent {
            dataset: dataset.name(),
            name: name.to_owned(),
            root: root.clone(),
        },
        _ => BenchError::UnknownSequence {
            dataset: dataset.name(),
            name: name.to_owned(),
            available: found.iter().map(|s| s.name.as_str()).collect::<Vec<_>>().join(", "),
        },
    }
}

/// The recipes, or the motions along the trajectories under `root`.
fn simulated(root: Option<&PathBuf>, request: &BenchRequest) -> Result<Vec<Sequence>, BenchError> {
    let Some(root) = root else {
        let named = |name: &str| request.sequences.iter().any(|wanted| wanted == name);
        let wanted = |recipe: &&super::Recipe| !request.quick || recipe.quick || named(recipe.name);
        let sequence = |recipe: &super::Recipe| Sequence {
            name: recipe.name.to_owned(),
            source: Source::Recipe { recipe: *recipe, trajectory: None },
            clock: Clock::Shared,
            one_camera: recipe.sensors == Sensors::Mono,
            settings: recipe.settings(),
            disturbed: recipe.disturbed.to_vec(),
        };
        return Ok(RECIPES.iter().filter(wanted).map(sequence).collect());
    };
    let io = |source| BenchError::Io { path: root.clone(), source };
    let mut files: Vec<PathBuf> = match std::fs::metadata(root).map_err(io)?.is_dir() {
        false => vec![root.clone()],
        true => {
            let entries = std::fs::read_dir(root).map_err(io)?;
            let paths = entries.map(|entry| Ok(entry.map_err(io)?.path()));
            paths.collect::<Result<Vec<_>, BenchError>>()?
        }
    };
    files.sort();
    let along = |file: PathBuf| {
        // What is no trajectory is no motion.
        read_trajectory(&file).ok()?;
        let recipe = super::recipe::ALONG;
        let name = file.file_stem()?.to_string_lossy().into_owned();
        Some(Sequence {
            name,
            settings: recipe.settings(),
            source: Source::Recipe { recipe, trajectory: Some(file) },
            clock: Clock::Shared,
            one_camera: false,
            disturbed: Vec::new(),
        })
    };
    let found: Vec<Sequence> =
        files.into_iter().filter(|f| f.is_file()).filter_map(along).collect();
    let (dataset, expected) = (request.dataset.name(), "trajectories (TUM format) to move along");
    match found.is_empty() {
        true => Err(BenchError::NothingFound { dataset, root: root.clone(), expected }),
        false => Ok(found),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(dataset: Dataset) -> BenchRequest {
        BenchRequest {
            dataset,
            root: None,
            sequences: Vec::new(),
            filters: Vec::new(),
            inits: Vec::new(),
            seeds: None,
            sweep: Vec::new(),
            settings: Vec::new(),
            config: None,
            duration: None,
            quick: false,
        }
    }

    #[test]
    fn an_axis_splits_at_commas_outside_lists() {
        let axis: Axis = "imu.gyro_noise=1e-3, 2e-3".parse().unwrap();
        assert_eq!((axis.key.as_str(), axis.values.len()), ("imu.gyro_noise", 2));
        let axis: Axis = "log.depth_invalid=[0, 1],[65535]".parse().unwrap();
        assert_eq!(axis.values, ["[0, 1]", "[65535]"]);
        for wrong in ["imu.gyro_noise", "gyro_noise=1", "imu.gyro_noise=", "imu.gyro_noise=1,,2"] {
            assert!(wrong.parse::<Axis>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_grid_has_every_combination() {
        let sweep =
            vec!["imu.gyro_noise=1,2".parse().unwrap(), "map.max_points=3,4,5".parse().unwrap()];
        assert_eq!(grid(&sweep).len(), 6);
        let request = BenchRequest {
            sequences: vec!["hall".to_owned()],
            filters: vec!["mfgs".to_owned(), "mekfs".to_owned()],
            inits: vec![InitMode::Auto, InitMode::Truth],
            seeds: Some(4),
            sweep: vec!["imu.gyro_noise=1e-3,2e-3".parse().unwrap()],
            ..request(Dataset::Sim)
        };
        let plan = plan(&request).unwrap();
        assert_eq!(plan.runs.len(), 2 * 2 * 2 * 4);
        assert_eq!(plan.runs[0].settings, ["imu.gyro_noise=1e-3"]);
        let rows = plan.runs.chunk_by(PlannedRun::is_seed_of).count();
        assert_eq!(rows, 8);
    }

    #[test]
    fn what_does_not_exist_is_refused_before_anything_runs() {
        type Case = (fn(&mut BenchRequest), &'static str);
        let cases: [Case; 4] = [
            (|r| r.sequences = vec!["lab-simpel".to_owned()], "lab-simpel"),
            (|r| r.filters = vec!["mfgx".to_owned()], "mfgx"),
            (|r| r.settings = vec!["imu.gyro_nois=1".to_owned()], "imu.gyro_noise"),
            (|r| r.dataset = Dataset::Euroc, "ROOT"),
        ];
        for (change, part) in cases {
            let mut request = request(Dataset::Sim);
            change(&mut request);
            let error = plan(&request).unwrap_err();
            assert!(error.is_usage() && error.to_string().contains(part), "{error}");
        }
    }

    #[test]
    fn a_short_look_takes_the_recipes_of_the_guard() {
        let quick = BenchRequest { quick: true, ..request(Dataset::Sim) };
        let plan = plan(&quick).unwrap();
        assert!(plan.runs.iter().all(|run| run.duration == Some(QUICK_SIMULATED)));
        let quick = RECIPES.iter().filter(|recipe| recipe.quick).count();
        assert_eq!(plan.runs.len(), quick * SEEDS as usize);
    }
}
