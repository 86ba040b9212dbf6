//! The regression guard: today's figures against stored ones.
//!
//! What a harmless change does to an estimate (another order of additions, another draw of RANSAC)
//! is at most what another seed does. So the spread over seeds, pooled over the rows since
//! logarithms of errors spread alike, gives the standard error of a difference of two means, and a
//! t-test its limit. The level of all tests together is [`LEVEL`]: of a hundred harmless changes
//! one is refused.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};
use statrs::distribution::{Binomial, ContinuousCDF, DiscreteCDF, StudentsT};

use super::error::BenchError;
use super::plan::PlannedRun;
use super::record::{Outcome, RunRecord};
use crate::evaluation::Table;

/// Probability that a harmless change is refused.
const LEVEL: f64 = 0.01;

/// Stored figures.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Guard {
    /// What made them.
    pub command: String,
    pub rows: Vec<StoredRow>,
}

/// Figures of one sequence and filter, by seed.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct StoredRow {
    pub sequence: String,
    pub filter: String,
    /// Positive figures by name, one a seed that has them.
    pub figures: BTreeMap<String, Vec<f64>>,
    pub coverage: Vec<f64>,
    /// Least number of frames of a run.
    pub frames: u64,
    pub failures: usize,
    pub false_alarms: u64,
    pub faults_missed: Vec<String>,
}

/// A figure that differs by more than seeds do.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// `all` for a difference of all rows together.
    pub sequence: String,
    pub filter: String,
    pub figure: String,
    /// Geometric means of positive figures, else counts or shares.
    pub stored: f64,
    pub found: f64,
    pub limit: f64,
    pub worse: bool,
}

/// Figures whose distance from what is consistent counts, either way.
const CONSISTENT: f64 = 3.0;
const NEES: &str = "nees";

impl Guard {
    pub fn of(command: &str, runs: &[(PlannedRun, RunRecord)]) -> Self {
        let rows = runs.chunk_by(|(a, _), (b, _)| a.is_seed_of(b)).filter_map(StoredRow::of);
        Self { command: command.to_owned(), rows: rows.collect() }
    }

    /// # Errors
    /// If the file cannot be read or holds no stored figures.
    pub fn read(path: &Path) -> Result<Self, BenchError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| BenchError::Io { path: path.to_owned(), source })?;
        serde_json::from_str(&text)
            .map_err(|e| BenchError::Format { path: path.to_owned(), reason: e.to_string() })
    }

    /// Replaces the file when all is written.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), BenchError> {
        let text = serde_json::to_string_pretty(self)
            .map_err(|e| BenchError::Format { path: path.to_owned(), reason: e.to_string() })?;
        let part = path.with_extension(format!("{}.part", std::process::id()));
        std::fs::write(&part, text + "\n")
            .and_then(|()| std::fs::rename(&part, path))
            .map_err(|source| BenchError::Io { path: path.to_owned(), source })
    }

    /// What `found` has that differs from the stored figures. Rows are compared where both have
    /// them; a stored row that was not found is a finding.
    pub fn compare(&self, found: &Self) -> Vec<Finding> {
        let mut pairs = Vec::new();
        let mut findings = Vec::new();
        for stored in &self.rows {
            let same = |row: &&StoredRow| {
                (&row.sequence, &row.filter) == (&stored.sequence, &stored.filter)
            };
            match found.rows.iter().find(same) {
                Some(found) => pairs.push((stored, found)),
                None => findings.push(stored.finding("rows", 1.0, 0.0, 1.0)),
            }
        }
        let mut names: Vec<&String> = self.rows.iter().flat_map(|row| row.figures.keys()).collect();
        names.sort_unstable();
        names.dedup();
        // Every row and all rows together, for every figure and the coverage.
        let tests = ((names.len() + 1) * (pairs.len() + 1)) as f64;
        for name in names {
            findings.extend(differences(name, &pairs, LEVEL / tests));
        }
        findings.extend(losses(&pairs, LEVEL / tests));
        findings.extend(pairs.iter().flat_map(|(stored, found)| failures(stored, found)));
        findings.extend(more_alarms(&pairs));
        findings
    }
}

impl StoredRow {
    fn of(runs: &[(PlannedRun, RunRecord)]) -> Option<Self> {
        let (first, _) = runs.first()?;
        let outcomes: Vec<&Outcome> = runs.iter().map(|(_, record)| &record.outcome).collect();
        type Named = (&'static str, fn(&Outcome) -> Option<f64>);
        let named: [Named; 6] = [
            ("ape_m", |o| o.ape_m),
            ("attitude_deg", |o| o.attitude_deg),
            ("rpe_1s_m", |o| o.rpe_1s_m),
            ("nees_attitude", |o| o.nees.and_then(|nees| nees.attitude)),
            ("nees_position", |o| o.nees.and_then(|nees| nees.position)),
            ("nees_velocity", |o| o.nees.and_then(|nees| nees.velocity)),
        ];
        let values = |figure: fn(&Outcome) -> Option<f64>| -> Vec<f64> {
            outcomes.iter().filter_map(|outcome| figure(outcome)).filter(|x| *x > 0.0).collect()
        };
        let figures = named.map(|(name, figure)| (name.to_owned(), values(figure)));
        Some(Self {
            sequence: first.sequence.name.clone(),
            filter: first.filter.clone(),
            figures: figures.into_iter().filter(|(_, values)| !values.is_empty()).collect(),
            coverage: outcomes.iter().map(|outcome| outcome.coverage).collect(),
            frames: outcomes.iter().map(|outcome| outcome.frames).min().unwrap_or(0),
            failures: outcomes.iter().filter(|outcome| outcome.ape_m.is_none()).count(),
            false_alarms: outcomes.iter().map(|outcome| outcome.false_alarms).sum(),
            faults_missed: {
                let missed = outcomes.iter().flat_map(|outcome| outcome.faults_missed.clone());
                missed.collect::<std::collections::BTreeSet<_>>().into_iter().collect()
            },
        })
    }

    fn finding(&self, figure: &str, stored: f64, found: f64, limit: f64) -> Finding {
        Finding {
            sequence: self.sequence.clone(),
            filter: self.filter.clone(),
            figure: figure.to_owned(),
            stored,
            found,
            limit,
            worse: true,
        }
    }

    fn logarithms(&self, name: &str) -> Vec<f64> {
        self.figures.get(name).map(|v| v.iter().map(|x| x.ln()).collect()).unwrap_or_default()
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Standard deviation within groups, pooled over them, with its degrees of freedom; `None` where
/// no group has two values.
fn pooled_spread<'a>(groups: impl Iterator<Item = &'a [f64]>) -> Option<(f64, f64)> {
    let (mut squares, mut freedom) = (0.0, 0.0);
    for group in groups.filter(|group| group.len() > 1) {
        let middle = mean(group);
        squares += group.iter().map(|x| (x - middle).powi(2)).sum::<f64>();
        freedom += (group.len() - 1) as f64;
    }
    (freedom > 0.0).then(|| ((squares / freedom).sqrt(), freedom))
}

/// Quantile of Student's t at `1 - level`.
fn t_quantile(freedom: f64, level: f64) -> Option<f64> {
    Some(StudentsT::new(0.0, 1.0, freedom).ok()?.inverse_cdf(1.0 - level))
}

/// Rows, and all rows together, whose mean logarithm of a figure has moved.
fn differences(name: &str, pairs: &[(&StoredRow, &StoredRow)], level: f64) -> Vec<Finding> {
    let logarithms: Vec<_> = pairs
        .iter()
        .map(|(stored, found)| (*stored, stored.logarithms(name), found.logarithms(name)))
        .filter(|(_, before, after)| !before.is_empty() && !after.is_empty())
        .collect();
    let groups = logarithms.iter().map(|(_, before, _)| before.as_slice());
    // Two-sided, as either way is told.
    let Some((limit, spread)) = pooled_spread(groups)
        .and_then(|(spread, freedom)| Some((t_quantile(freedom, level / 2.0)?, spread)))
    else {
        return Vec::new();
    };
    let told = |row: &StoredRow, before: f64, after: f64, variance: f64| {
        let allowed = limit * spread * variance.sqrt();
        let distance = |x: f64| (x - CONSISTENT.ln()).abs();
        let worse = match name.starts_with(NEES) {
            true => distance(after) > distance(before),
            false => after > before,
        };
        let bound = if after > before { before + allowed } else { before - allowed };
        ((after - before).abs() > allowed)
            .then(|| Finding { worse, ..row.finding(name, before.exp(), after.exp(), bound.exp()) })
    };
    let inverse =
        |before: &[f64], after: &[f64]| 1.0 / before.len() as f64 + 1.0 / after.len() as f64;
    let mut findings: Vec<Finding> = logarithms
        .iter()
        .filter_map(|(row, before, after)| {
            told(row, mean(before), mean(after), inverse(before, after))
        })
        .collect();
    type Compared<'a> = (&'a StoredRow, Vec<f64>, Vec<f64>);
    let means = |side: fn(&Compared) -> f64| mean(&logarithms.iter().map(side).collect::<Vec<_>>());
    let count = logarithms.len() as f64;
    let variance = logarithms.iter().map(|(_, b, a)| inverse(b, a)).sum::<f64>() / (count * count);
    let all = StoredRow { sequence: "all".to_owned(), ..StoredRow::default() };
    let (before, after) =
        (means(|(_, before, _)| mean(before)), means(|(_, _, after)| mean(after)));
    findings.extend(told(&all, before, after, variance));
    findings
}

/// Rows that cover less of the truth.
fn losses(pairs: &[(&StoredRow, &StoredRow)], level: f64) -> Vec<Finding> {
    let spread = pooled_spread(pairs.iter().map(|(stored, _)| stored.coverage.as_slice()));
    let limit = spread.and_then(|(sd, freedom)| Some(sd * t_quantile(freedom, level)?));
    let loss = |(stored, found): &(&StoredRow, &StoredRow)| {
        if stored.coverage.is_empty() || found.coverage.is_empty() {
            return None;
        }
        let share = 1.0 / stored.coverage.len() as f64 + 1.0 / found.coverage.len() as f64;
        // An estimate may begin or end a frame earlier or later.
        let frame = 1.0 / stored.frames.max(1) as f64;
        let bound = mean(&stored.coverage) - (limit.unwrap_or(0.0) * share.sqrt()).max(frame);
        let after = mean(&found.coverage);
        (after < bound).then(|| stored.finding("coverage", mean(&stored.coverage), after, bound))
    };
    pairs.iter().filter_map(loss).collect()
}

/// Runs that fail and faults that are missed which were not.
fn failures(stored: &StoredRow, found: &StoredRow) -> Vec<Finding> {
    let count = |name: &str, before: usize, after: usize| {
        (after > before).then(|| stored.finding(name, before as f64, after as f64, before as f64))
    };
    let missed = found.faults_missed.iter().filter(|f| !stored.faults_missed.contains(f)).count();
    let failed = count("failures", stored.failures, found.failures);
    failed.into_iter().chain(count("faults missed", 0, missed)).collect()
}

/// More false alarms than two draws of the same rate would have.
fn more_alarms(pairs: &[(&StoredRow, &StoredRow)]) -> Option<Finding> {
    let before: u64 = pairs.iter().map(|(stored, _)| stored.false_alarms).sum();
    let after: u64 = pairs.iter().map(|(_, found)| found.false_alarms).sum();
    if after <= before {
        return None;
    }
    // Of all alarms half are expected on either side.
    let halves = Binomial::new(0.5, before + after).ok()?;
    let is_chance = |after: u64| halves.sf(after.saturating_sub(1)) >= LEVEL;
    let all = StoredRow { sequence: "all".to_owned(), ..StoredRow::default() };
    let limit = before as f64;
    (!is_chance(after)).then(|| all.finding("false alarms", before as f64, after as f64, limit))
}

/// The findings for the terminal.
pub fn findings_table(findings: &[Finding]) -> Table {
    let mut table = Table::new(["", "sequence", "filter", "figure", "stored", "found", "limit"]);
    for finding in findings {
        let number = |value: f64| format!("{value:.4}");
        table.push([
            if finding.worse { "WORSE" } else { "better" }.to_owned(),
            finding.sequence.clone(),
            finding.filter.clone(),
            finding.figure.clone(),
            number(finding.stored),
            number(finding.found),
            number(finding.limit),
        ]);
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    /// Six rows of three seeds, whose errors spread by a factor of 1.35, times `factor`.
    fn guard(rng: &mut ChaCha8Rng, factor: f64) -> Guard {
        let mut value = |middle: f64| {
            let x: f64 = StandardNormal.sample(rng);
            middle * (0.3 * x).exp()
        };
        let row = |k: usize| {
            let mut seeds = |middle: f64| (0..3).map(|_| value(middle)).collect::<Vec<f64>>();
            StoredRow {
                sequence: format!("s{k}"),
                filter: "mfgs".to_owned(),
                figures: BTreeMap::from([
                    ("ape_m".to_owned(), seeds(0.004 * factor)),
                    ("nees_attitude".to_owned(), seeds(3.0)),
                ]),
                coverage: vec![1.0; 3],
                frames: 240,
                ..StoredRow::default()
            }
        };
        Guard { command: String::new(), rows: (0..6).map(row).collect() }
    }

    #[test]
    fn harmless_changes_pass_and_harmful_ones_do_not() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (mut refused, mut caught) = (0, 0);
        for _ in 0..300 {
            let stored = guard(&mut rng, 1.0);
            let is_worse = |found: &Guard| stored.compare(found).iter().any(|f| f.worse);
            refused += u32::from(is_worse(&guard(&mut rng, 1.0)));
            // The limit of all 18 runs together: Student's t with 12 degrees of freedom at a level of
            // 0.01/21 on either side, 4.9 times 0.3 sqrt(2/18), is a factor of 1.63.
            caught += u32::from(is_worse(&guard(&mut rng, 2.0)));
        }
        // One in a hundred is expected; six in 300 of a binomial are at the 97 % quantile.
        assert!(refused <= 6, "{refused}");
        assert!(caught >= 270, "{caught}");
    }

    #[test]
    fn the_same_figures_have_no_findings() {
        let stored = guard(&mut ChaCha8Rng::seed_from_u64(1), 1.0);
        assert!(stored.compare(&stored).is_empty());
    }

    #[test]
    fn consistency_counts_either_way() {
        let stored = guard(&mut ChaCha8Rng::seed_from_u64(1), 1.0);
        for factor in [0.2, 5.0] {
            let mut found = stored.clone();
            for row in &mut found.rows {
                let nees = row.figures.get_mut("nees_attitude").unwrap();
                nees.iter_mut().for_each(|value| *value *= factor);
            }
            let findings = stored.compare(&found);
            assert!(findings.iter().any(|f| f.worse && f.figure == "nees_attitude"), "{factor}");
            let back = found.compare(&stored);
            assert!(!back.is_empty() && back.iter().all(|finding| !finding.worse));
        }
    }

    #[test]
    fn losses_are_told() {
        let stored = guard(&mut ChaCha8Rng::seed_from_u64(1), 1.0);
        type Change = (fn(&mut Guard), &'static str);
        let changes: [Change; 5] = [
            (|g| g.rows[0].coverage = vec![0.9; 3], "coverage"),
            (|g| g.rows[0].failures = 1, "failures"),
            (|g| g.rows[0].faults_missed = vec!["black:4:1".to_owned()], "faults missed"),
            (|g| g.rows[0].false_alarms = 9, "false alarms"),
            (|g| drop(g.rows.remove(0)), "rows"),
        ];
        for (change, figure) in changes {
            let mut found = stored.clone();
            change(&mut found);
            let findings = stored.compare(&found);
            assert!(findings.iter().any(|f| f.worse && f.figure == figure), "{figure}");
        }
    }

    #[test]
    fn a_file_gives_back_what_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("figures.json");
        let mut stored = guard(&mut ChaCha8Rng::seed_from_u64(1), 1.0);
        for row in &mut stored.rows {
            row.figures.values_mut().flatten().for_each(|x| *x = (*x * 1e6).round() / 1e6);
        }
        stored.write(&path).unwrap();
        assert_eq!(Guard::read(&path).unwrap(), stored);
        std::fs::write(&path, "{").unwrap();
        assert!(Guard::read(&path).unwrap_err().to_string().contains("figures.json"));
    }
}
