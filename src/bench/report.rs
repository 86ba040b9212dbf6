//! The table of a bench, for terminal, page and paper.

use std::collections::BTreeMap;

use serde::Serialize;

use super::dataset::Dataset;
use super::figures::{Row, Spread};
use super::published::published;
use crate::evaluation::{Cell, Curve, CurvePanel, Figure, Panel, Report, Scale, Table};

/// What `bench --json` prints.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BenchReport {
    pub dataset: &'static str,
    pub rows: Vec<Row>,
    /// Sequences of the data set that are not there.
    pub missing: Vec<String>,
    /// Where the published figures come from, by estimator.
    pub sources: BTreeMap<&'static str, &'static str>,
    pub notes: &'static [&'static str],
}

impl BenchReport {
    pub fn new(dataset: Dataset, rows: Vec<Row>, missing: Vec<String>) -> Self {
        let is_shown = |estimator: &str| rows.iter().any(|r| r.published.contains_key(estimator));
        let sources = published(dataset)
            .iter()
            .filter(|entry| is_shown(entry.estimator))
            .map(|entry| (entry.estimator, entry.source))
            .collect();
        Self { dataset: dataset.name(), rows, missing, sources, notes: dataset.notes() }
    }

    /// Keys that a sweep varies, in the order of the rows.
    fn swept(&self) -> Vec<&str> {
        let mut keys: Vec<&str> =
            self.rows.iter().flat_map(|row| row.settings.keys().map(String::as_str)).collect();
        keys.sort_unstable();
        keys.dedup();
        keys
    }

    /// The figures of the runs.
    pub fn table(&self) -> Table {
        let swept = self.swept();
        let with_init = self.rows.iter().any(|row| row.init.is_some());
        let mut columns = vec!["sequence", "filter"];
        columns.extend(with_init.then_some("start"));
        columns.extend(&swept);
        columns.extend([
            "seeds",
            "coverage, %",
            "APE, m",
            "attitude, deg",
            "RPE 1 s, m",
            "NEES att.",
            "NEES pos.",
            "NEES vel.",
            "inside 95 %",
            "CPU ms/frame",
            "false alarms",
        ]);
        let rows = self.rows.iter().map(|row| {
            let mut cells = vec![row.sequence.clone(), row.filter.clone()];
            cells.extend(with_init.then(|| row.init.clone().unwrap_or_else(|| "-".to_owned())));
            cells.extend(
                swept.iter().map(|key| row.settings.get(*key).cloned().unwrap_or_default()),
            );
            cells.extend(figures(row));
            cells.into_iter().map(Cell::Text).collect()
        });
        Table { rows: rows.collect(), columns: columns.into_iter().map(str::to_owned).collect() }
    }

    /// Position errors beside the published ones; `None` where there are none.
    pub fn comparison(&self) -> Option<Table> {
        let others: Vec<&str> = self.sources.keys().copied().collect();
        if others.is_empty() {
            return None;
        }
        let columns = ["sequence", "filter", "coverage, %", "here, median"].into_iter();
        let number = |value: Option<f64>| {
            Cell::Text(value.map_or_else(|| "-".to_owned(), |value| format!("{value:.3}")))
        };
        let rows = self.rows.iter().map(|row| {
            let mut cells = vec![
                Cell::Text(row.sequence.clone()),
                Cell::Text(row.filter.clone()),
                Cell::Text(format!("{:.1}", 100.0 * row.coverage)),
                number(row.ape_m.map(|spread| spread.median)),
            ];
            cells.extend(others.iter().map(|name| number(row.published.get(*name).copied())));
            cells
        });
        Some(Table {
            rows: rows.collect(),
            columns: columns.chain(others.iter().copied()).map(str::to_owned).collect(),
        })
    }

    /// What failed, was warned of or was not there.
    pub fn remarks(&self) -> Vec<String> {
        let mut remarks = Vec::new();
        for row in &self.rows {
            let name = format!("{}, {}", row.sequence, row.filter);
            if let Some(reason) = &row.failure {
                remarks.push(format!("{name}: {} of {} failed: {reason}", row.failures, row.seeds));
            }
            if !row.faults_missed.is_empty() {
                remarks.push(format!("{name}: not named: {}", row.faults_missed.join(", ")));
            }
            if !row.faults.is_empty() {
                remarks.push(format!("{name}: named: {}", row.faults.join("; ")));
            }
        }
        if !self.missing.is_empty() {
            let (dataset, list) = (self.dataset, self.missing.join(", "));
            remarks.push(format!("absent: {list} (datasets/{dataset}.md says where to get them)"));
        }
        remarks
    }

    /// Everything for the terminal.
    pub fn to_text(&self) -> String {
        let mut text = self.table().to_text();
        if let Some(comparison) = self.comparison() {
            text +=
                &format!("\nposition RMSE, m, beside published figures\n{}", comparison.to_text());
            let sources = self.sources.iter().map(|(name, source)| format!("{name}: {source}\n"));
            text.extend(sources);
        }
        let lines = self.remarks().into_iter().chain(self.notes.iter().map(|n| (*n).to_owned()));
        let lines: Vec<String> = lines.map(|line| line + "\n").collect();
        if !lines.is_empty() {
            text.push('\n');
        }
        text.extend(lines);
        text
    }

    /// Both tables for a paper, with a comment that names the sources.
    pub fn to_latex(&self) -> String {
        let mut text = format!("% mfg-vio bench {}\n{}", self.dataset, self.table().to_latex());
        if let Some(comparison) = self.comparison() {
            for (name, source) in &self.sources {
                text += &format!("% {name}: {source}\n");
            }
            text += &comparison.to_latex();
        }
        text
    }
}

fn figures(row: &Row) -> [String; 11] {
    let number = |value: Option<f64>, digits: usize| {
        value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
    };
    let spread = |value: Option<Spread>, digits: usize| match value {
        Some(Spread { median, min, max }) if row.seeds > 1 => {
            format!("{median:.digits$} [{min:.digits$}, {max:.digits$}]")
        }
        value => number(value.map(|spread| spread.median), digits),
    };
    let nees = &row.nees;
    [
        match row.failures {
            0 => row.seeds.to_string(),
            failures => format!("{} ({failures} failed)", row.seeds),
        },
        format!("{:.1}", 100.0 * row.coverage),
        spread(row.ape_m, 4),
        spread(row.attitude_deg, 2),
        spread(row.rpe_1s_m, 4),
        number(nees.attitude, 2),
        number(nees.position, 2),
        number(nees.velocity, 2),
        number(nees.inside_95.map(|share| 100.0 * share), 1),
        number(row.cpu_ms_per_frame, 1),
        row.false_alarms.to_string(),
    ]
}

/// The page of a bench.
pub fn report(bench: &BenchReport, command: &str) -> Report {
    let mut tables = vec![("Results".to_owned(), bench.table())];
    if let Some(comparison) = bench.comparison() {
        tables.push(("Position RMSE beside published figures, m".to_owned(), comparison));
        let mut sources = Table::new(["estimator", "source"]);
        for (name, source) in &bench.sources {
            sources.push([*name, *source]);
        }
        tables.push(("Sources".to_owned(), sources));
    }
    let how = "Coverage: share of the truth's duration with an estimate. APE, attitude: RMSE after \
               SE(3) alignment. RPE: RMSE of the motion over 1 s. Median [least, largest] over \
               seeds. NEES: mean, 3 when consistent, first poses put on each other; inside 95 %: \
               share of the joint errors of attitude and position inside their band.";
    let notes = [format!("Made by: {command}"), how.to_owned()];
    Report {
        title: format!("mfg-vio bench {}", bench.dataset),
        notes: notes.into_iter().chain(bench.notes.iter().map(|n| (*n).to_owned())).collect(),
        warnings: bench.remarks(),
        tables,
        figures: sweep_figure(bench).into_iter().collect(),
    }
}

/// What a setting does to error, consistency and time; `None` unless something is swept. With
/// several settings each combination of the others has a curve of its own.
pub fn sweep_figure(bench: &BenchReport) -> Option<Figure> {
    let keys = bench.swept();
    type Quantity = (&'static str, &'static str, fn(&Row) -> Option<f64>);
    let quantities: [Quantity; 4] = [
        ("Position RMSE", "m", |row| row.ape_m.map(|spread| spread.median)),
        ("Attitude RMSE", "deg", |row| row.attitude_deg.map(|spread| spread.median)),
        ("NEES of the position", "3 is consistent", |row| row.nees.position),
        ("Processor time", "ms a frame", |row| row.cpu_ms_per_frame),
    ];
    let panels: Vec<Panel> = keys
        .iter()
        .flat_map(|key| {
            quantities.map(|(title, unit, value)| panel(bench, key, (title, unit), &value))
        })
        .collect();
    let title = format!("mfg-vio bench {}: {}", bench.dataset, keys.join(", "));
    (!panels.is_empty()).then_some(Figure { title, panels, columns: quantities.len() })
}

fn panel(
    bench: &BenchReport,
    key: &str,
    (title, unit): (&str, &str),
    value: &dyn Fn(&Row) -> Option<f64>,
) -> Panel {
    let mut places: Vec<&str> = Vec::new();
    for row in &bench.rows {
        if let Some(place) = row.settings.get(key)
            && !places.contains(&place.as_str())
        {
            places.push(place);
        }
    }
    let numbers: Option<Vec<f64>> = places.iter().map(|place| place.parse().ok()).collect();
    let mut curves: Vec<Curve> = Vec::new();
    for row in &bench.rows {
        let Some(place) = row.settings.get(key) else { continue };
        let Some(index) = places.iter().position(|other| other == place) else { continue };
        // A value that is no number has its place in the list.
        let x = numbers.as_ref().map_or(index as f64, |numbers| numbers[index]);
        let others = row.settings.iter().filter(|(other, _)| *other != key);
        let rest: String = others.map(|(k, v)| format!(", {k}={v}")).collect();
        let name = format!("{}, {}{rest}", row.sequence, row.filter);
        let point = [x, value(row).unwrap_or(f64::NAN)];
        match curves.iter_mut().find(|curve| curve.name == name) {
            Some(curve) => curve.points.push(point),
            None => curves.push(Curve { name, points: vec![point] }),
        }
    }
    let spans = |numbers: &Vec<f64>| {
        let (min, max) =
            numbers.iter().fold((f64::MAX, 0.0_f64), |(a, b), x| (a.min(*x), b.max(*x)));
        min > 0.0 && max >= 10.0 * min
    };
    let logarithmic = numbers.as_ref().is_some_and(spans);
    let x_label = match &numbers {
        Some(_) => key.to_owned(),
        None => format!("{key}: {}", places.join(", ")),
    };
    Panel::Curves(CurvePanel {
        title: title.to_owned(),
        x_label,
        y_label: unit.to_owned(),
        curves,
        x_scale: if logarithmic { Scale::Logarithmic } else { Scale::default() },
        ..Default::default()
    })
}

#[cfg(test)]
mod tests {
    use super::super::figures::NeesMeans;
    use super::*;

    fn row(sequence: &str, settings: &[(&str, &str)], ape: f64) -> Row {
        let value = |x: f64| Some(Spread { median: x, min: x / 2.0, max: 2.0 * x });
        Row {
            sequence: sequence.to_owned(),
            filter: "mfgs".to_owned(),
            init: None,
            settings: settings.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect(),
            seeds: 3,
            failures: 0,
            failure: None,
            coverage: 1.0,
            ape_m: value(ape),
            attitude_deg: value(0.5),
            rpe_1s_m: None,
            nees: NeesMeans { position: Some(3.2), ..NeesMeans::default() },
            cpu_ms_per_frame: Some(12.0),
            false_alarms: 0,
            faults: Vec::new(),
            faults_missed: Vec::new(),
            published: super::super::published::of_sequence(Dataset::Euroc, sequence),
        }
    }

    #[test]
    fn published_figures_stand_beside_with_their_sources() {
        let rows = vec![row("V1_01_easy", &[], 0.08), row("own", &[], 0.3)];
        let bench = BenchReport::new(Dataset::Euroc, rows, vec!["MH_01_easy".to_owned()]);
        let text = bench.to_text();
        for part in ["0.0800 [0.0400, 0.1600]", "OKVIS2", "0.043", "2202.09199", "absent: MH_01"] {
            assert!(text.contains(part), "{part}\n{text}");
        }
        assert!(bench.to_latex().contains("\\toprule"));
        let json = serde_json::to_value(&bench).unwrap();
        assert_eq!(json["rows"][0]["published"]["OKVIS2"], 0.043);
        assert_eq!(json["rows"][0]["ape_m"]["median"], 0.08);
        assert!(json["rows"][0].get("settings").is_none());
        assert!(sweep_figure(&bench).is_none());
    }

    #[test]
    fn a_sweep_has_a_curve_for_each_combination_of_the_others() {
        let (a, b) = ("imu.gyro_noise", "init.mode");
        let rows = vec![
            row("hall", &[(a, "1e-3"), (b, "auto")], 0.1),
            row("hall", &[(a, "1e-2"), (b, "auto")], 0.2),
            row("hall", &[(a, "1e-3"), (b, "truth")], 0.3),
        ];
        let bench = BenchReport::new(Dataset::Sim, rows, Vec::new());
        let figure = sweep_figure(&bench).unwrap();
        assert_eq!(figure.panels.len(), 8);
        let Panel::Curves(noise) = &figure.panels[0] else { panic!("curves") };
        assert_eq!((noise.curves.len(), noise.x_scale), (2, Scale::Logarithmic));
        assert_eq!(noise.curves[0].points, [[1e-3, 0.1], [1e-2, 0.2]]);
        let Panel::Curves(mode) = &figure.panels[4] else { panic!("curves") };
        assert_eq!(mode.curves[0].points, [[0.0, 0.1], [1.0, 0.3]]);
        assert!(figure.to_svg().unwrap().contains("init.mode: auto, truth"));
    }
}
