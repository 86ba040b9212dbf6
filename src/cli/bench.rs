use std::path::{Path, PathBuf};

use anyhow::Context;
use indicatif::ProgressBar;

use super::terminal::{INTERRUPTED, catch_interrupts, print, progress, tell};
use mfg_vio::bench::{
    Axis, BenchError, BenchReport, BenchRequest, Dataset, Guard, Plan, Progress, Store, Workshop,
    execute, findings_table, plan, report, rows, sweep_figure,
};
use mfg_vio::evaluation::write_html;
use mfg_vio::odometry::InitMode;

/// Run a standard data set and put the figures beside published ones.
///
/// Data sets: euroc, euroc-mono, tum-vi, vcu-rvi, openloris, tum-rgbd, seven-scenes, broad,
/// kitti-imu-gps; and sim, which is rendered on demand and needs no download. ROOT is the folder
/// of the recordings in their own layout, or one of them; the pages in datasets/ say where to get
/// them. For sim ROOT may hold trajectories (TUM format) to move along.
///
/// Finished runs are kept, so that an interrupted bench goes on when it is started again: a run is
/// recognised by its input, settings, filter, seed and the program itself. With --out the
/// directory receives results.json, results.csv, results.html, results.tex, with a sweep
/// sweep.svg, and the runs.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  mfg-vio bench sim --quick\n  \
                        mfg-vio bench euroc data/euroc --filters mfgs,mekfs --seeds 3 --out bench\n  \
                        mfg-vio bench sim --sequences lab-motion --sweep imu.gyro_noise=3e-4,1e-3,3e-3")]
pub struct BenchArgs {
    /// The data set.
    #[arg(value_name = "DATASET")]
    dataset: Dataset,
    /// Folder of its recordings.
    root: Option<PathBuf>,
    /// Only these sequences.
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    sequences: Vec<String>,
    /// Filters [default: the data set's default filter].
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    filters: Vec<String>,
    /// Starts, as --init of replay [default: init.mode of the configuration].
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    inits: Vec<InitMode>,
    /// Runs of each, with seeds from 1 on; of sim each has a log of its own [default: 3].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: Option<u64>,
    /// Vary a setting (repeatable: every combination).
    #[arg(long, value_name = "KEY=A,B,C")]
    sweep: Vec<String>,
    /// Override a key of the configuration (repeatable).
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Configuration of the sensor set-up; by default chosen by the log's layout.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Use only this much of each recording, or render this much, s.
    #[arg(long, value_name = "S", value_parser = positive_seconds)]
    duration: Option<f64>,
    /// A short look: of recordings the first 20 s; of sim 8 s of the most telling recipes.
    #[arg(long)]
    quick: bool,
    /// Directory for tables, page, plot and runs.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Folder of rendered logs and, without --out, of finished runs
    /// [default: mfg-vio/bench in the user's cache folder].
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    /// Keep rendered logs; by default they go when the last run that needs them is done.
    #[arg(long)]
    keep_logs: bool,
    /// Threads of a run; the figures do not depend on it.
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=64))]
    threads: u32,
    /// Say what would be run, and run nothing.
    #[arg(long)]
    dry_run: bool,
    /// Compare with the stored figures of this file; fails if anything is worse than the spread
    /// over seeds allows.
    #[arg(long, value_name = "FILE", conflicts_with = "write_guard")]
    guard: Option<PathBuf>,
    /// Store the figures for --guard in this file.
    #[arg(long, value_name = "FILE")]
    write_guard: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

fn positive_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value.is_finite() => Ok(value),
        _ => Err("expected a number of seconds, more than 0".to_owned()),
    }
}

pub fn run(args: &BenchArgs) -> anyhow::Result<()> {
    catch_interrupts()?;
    let plan = request(args).and_then(|request| plan(&request)).map_err(exit_if_usage)?;
    if args.dry_run {
        return print_plan(&plan, args.json);
    }
    let stored = args.guard.as_deref().map(Guard::read).transpose()?;
    let cache = args.cache.clone().map_or_else(default_cache, Ok)?;
    let store = Store::open(&args.out.as_ref().unwrap_or(&cache).join("runs"))?;
    let workshop = Workshop {
        store: &store,
        cache: &cache.join("logs"),
        keep_logs: args.keep_logs,
        threads: args.threads as usize,
        stop: &INTERRUPTED,
    };
    let mut bars = Bars::default();
    let runs = execute(&plan, &workshop, &mut bars);
    bars.clear();
    let runs = runs?;
    let results = BenchReport::new(plan.dataset, rows(plan.dataset, &runs), plan.missing.clone());
    if let Some(out) = &args.out {
        save(out, &results)?;
    }
    let output = match args.json {
        true => serde_json::to_string(&results)? + "\n",
        false => results.to_text(),
    };
    print(&output)?;
    let found = Guard::of(&command_line(), &runs);
    if let Some(path) = &args.write_guard {
        found.write(path)?;
        tell(&format!("stored: {}", path.display()));
    }
    stored.map_or(Ok(()), |stored| judge(&stored, &found))
}

/// A wrong command line ends the program with status 2.
fn exit_if_usage(error: BenchError) -> BenchError {
    if error.is_usage() {
        clap::Error::raw(clap::error::ErrorKind::ValueValidation, format!("{error}\n")).exit()
    }
    error
}

fn request(args: &BenchArgs) -> Result<BenchRequest, BenchError> {
    Ok(BenchRequest {
        dataset: args.dataset,
        root: args.root.clone(),
        sequences: args.sequences.clone(),
        filters: args.filters.clone(),
        inits: args.inits.clone(),
        seeds: args.seeds,
        sweep: args.sweep.iter().map(|text| text.parse::<Axis>()).collect::<Result<_, _>>()?,
        settings: args.overrides.clone(),
        config: args.config.clone(),
        duration: args.duration,
        quick: args.quick,
    })
}

/// The folder of this program in the user's cache folder.
fn default_cache() -> anyhow::Result<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
    let cache = set("XDG_CACHE_HOME").map(PathBuf::from);
    let cache = cache.or_else(|| Some(PathBuf::from(set("HOME")?).join(".cache")));
    let cache = cache.context("neither XDG_CACHE_HOME nor HOME is set; give --cache DIR")?;
    Ok(cache.join("mfg-vio").join("bench"))
}

fn print_plan(plan: &Plan, json: bool) -> anyhow::Result<()> {
    let output = match json {
        true => {
            let mut sequences: Vec<&str> =
                plan.runs.iter().map(|run| run.sequence.name.as_str()).collect();
            sequences.dedup();
            serde_json::json!({
                "dataset": plan.dataset.name(),
                "sequences": sequences,
                "missing": plan.missing,
                "runs": plan.runs.iter().map(|run| run.label()).collect::<Vec<_>>(),
            })
            .to_string()
        }
        false => plan.runs.iter().map(|run| run.label()).collect::<Vec<_>>().join("\n"),
    };
    print(&output)
}

fn save(out: &Path, results: &BenchReport) -> anyhow::Result<()> {
    let write = |name: &str, text: String| {
        let path = out.join(name);
        let part = path.with_extension("part");
        std::fs::write(&part, text)
            .and_then(|()| std::fs::rename(&part, &path))
            .with_context(|| path.display().to_string())
    };
    write("results.json", serde_json::to_string_pretty(results)? + "\n")?;
    write("results.csv", results.table().to_csv())?;
    write("results.tex", results.to_latex())?;
    write_html(&out.join("results.html"), &report(results, &command_line()))?;
    if let Some(figure) = sweep_figure(results) {
        figure.save(&out.join("sweep.svg"))?;
    }
    Ok(())
}

fn command_line() -> String {
    let arguments = std::env::args().skip(1);
    std::iter::once("mfg-vio".to_owned()).chain(arguments).collect::<Vec<_>>().join(" ")
}

fn judge(stored: &Guard, found: &Guard) -> anyhow::Result<()> {
    let findings = stored.compare(found);
    let worse = findings.iter().filter(|finding| finding.worse).count();
    if !findings.is_empty() {
        tell(findings_table(&findings).to_text().trim_end());
    }
    anyhow::ensure!(
        worse == 0,
        "{worse} figures are worse than stored; if that is meant, renew them with --write-guard"
    );
    Ok(())
}

/// One bar for the frames of a run, which says how many runs are done.
#[derive(Default)]
struct Bars(Option<ProgressBar>);

impl Bars {
    fn clear(&mut self) {
        if let Some(bar) = self.0.take() {
            bar.finish_and_clear();
        }
    }
}

impl Progress for Bars {
    fn begin(&mut self, label: &str, done: usize, planned: usize, frames: Option<u64>) {
        self.clear();
        self.0 = Some(progress(frames, &format!("[{}/{planned}] {label}", done + 1)));
    }

    fn frame(&mut self) {
        if let Some(bar) = &self.0 {
            bar.inc(1);
        }
    }
}
