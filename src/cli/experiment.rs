use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;

use super::terminal::{INTERRUPTED, catch_interrupts, print, progress};
use mfg_vio::evaluation::Table;
use mfg_vio::experiment::{self, Report, Request, Row};
use mfg_vio::output;

/// Rerun a numerical study of the papers.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  mfg-vio experiment wang-2.1 --runs 100000")]
pub struct ExperimentArgs {
    /// The study; see --list.
    #[arg(required_unless_present = "list")]
    name: Option<String>,
    /// Print the studies and what they show.
    #[arg(long)]
    list: bool,
    /// Monte Carlo runs; as many as the paper's if not given.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    runs: Option<u64>,
    /// Seed of everything random.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Threads; one a core if not given. The result does not depend on it.
    #[arg(long, value_name = "N", default_value_t = 0)]
    threads: usize,
    /// Write the report (JSON) and its figures (SVG and PNG) here.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &ExperimentArgs) -> anyhow::Result<()> {
    if args.list {
        let mut table = Table::new(["study", "runs", "what it shows"]);
        for study in experiment::studies() {
            table.push([study.name.to_owned(), study.runs.to_string(), study.title.to_owned()]);
        }
        return print(&table.to_text());
    }
    let name = args.name.as_deref().unwrap_or_default();
    let study = experiment::find(name).with_context(|| unknown(name))?;
    catch_interrupts()?;
    let runs = args.runs.map_or(study.runs, |runs| runs as usize);
    let bar = progress(Some(runs as u64), "runs");
    let finished_run = || bar.inc(1);
    let request =
        Request { runs, seed: args.seed, stop: &INTERRUPTED, finished_run: &finished_run };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build()?;
    let report = pool.install(|| (study.run)(&request))?;
    bar.finish_and_clear();
    if let Some(directory) = &args.out {
        write(&report, directory)?;
    }
    let text = if args.json {
        serde_json::to_string(&report)?
    } else {
        let (name, title) = (study.name, study.title);
        let heading = format!("{name}: {title} ({} runs, seed {})", report.runs, report.seed);
        let lines = [heading, table(&report).to_text().trim_end().to_owned()];
        lines.into_iter().chain(report.notes).collect::<Vec<_>>().join("\n")
    };
    print(&text)
}

/// `NAME.json`, and each figure as `NAME.svg` and `NAME.png`, numbered where there are several.
fn write(report: &Report, directory: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(directory).with_context(|| directory.display().to_string())?;
    let path = directory.join(format!("{}.json", report.name));
    output::write(&path, serde_json::to_string(report)?)
        .with_context(|| path.display().to_string())?;
    for (n, figure) in report.figures.iter().enumerate() {
        let number = if report.figures.len() > 1 { format!("-{}", n + 1) } else { String::new() };
        for extension in ["svg", "png"] {
            figure.save(&directory.join(format!("{}{number}.{extension}", report.name)))?;
        }
    }
    Ok(())
}

fn unknown(name: &str) -> String {
    let nearest = experiment::studies()
        .map(|study| (strsim::jaro_winkler(name, study.name), study.name))
        .max_by(|a, b| a.0.total_cmp(&b.0));
    match nearest {
        Some((_, nearest)) => {
            format!("there is no study `{name}`; did you mean `{nearest}`? See experiment --list")
        }
        None => format!("there is no study `{name}`"),
    }
}

fn table(report: &Report) -> Table {
    let mut table =
        Table::new(["case", "filter", "quantity", "mean", "sd", "paper", "p against", "step, us"]);
    for row in &report.rows {
        table.push([
            row.case.clone(),
            row.filter.clone(),
            row.quantity.clone(),
            number(row.mean),
            number(row.sd),
            row.paper.map_or_else(String::new, number),
            p_values(row),
            row.step_time_ns.map_or_else(String::new, |ns| format!("{:.2}", ns / 1000.0)),
        ]);
    }
    table
}

fn number(value: f64) -> String {
    if value != 0.0 && value.abs() < 1e-3 { format!("{value:.3e}") } else { format!("{value:.4}") }
}

fn p_values(row: &Row) -> String {
    let all: Vec<String> = row.p_vs.iter().map(|(rival, p)| format!("{rival} {p:.2e}")).collect();
    all.join(", ")
}
