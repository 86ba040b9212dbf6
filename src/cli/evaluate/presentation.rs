//! What a command has to show, and where to.

use std::path::PathBuf;

use clap::Args;
use mfg_vio::evaluation::{Figure, Report, Table, write_html};

use super::super::terminal::{print, tell};
use super::arguments::plot_file;

/// Everything that a command has to show, before it is known where.
pub(super) struct Presentation {
    pub(super) title: String,
    pub(super) notes: Vec<String>,
    pub(super) warnings: Vec<String>,
    pub(super) json: serde_json::Value,
    /// The first one is what `--csv` and `--latex` print.
    pub(super) tables: Vec<(String, Table)>,
    /// The first one is what `--plot` saves.
    pub(super) figures: Vec<Figure>,
}

#[derive(Debug, Args)]
pub(super) struct Output {
    /// One JSON object on standard output
    #[arg(long, conflicts_with_all = ["csv", "latex"])]
    pub(super) json: bool,
    /// A CSV table on standard output
    #[arg(long, conflicts_with = "latex")]
    pub(super) csv: bool,
    /// A LaTeX table (booktabs) on standard output
    #[arg(long)]
    pub(super) latex: bool,
    /// Plot, as SVG or PNG
    #[arg(long, value_name = "FILE", value_parser = plot_file)]
    pub(super) plot: Option<PathBuf>,
    /// Self-contained HTML report
    #[arg(long, value_name = "FILE")]
    pub(super) report: Option<PathBuf>,
}

impl Output {
    pub(super) fn draws(&self) -> bool {
        self.plot.is_some() || self.report.is_some()
    }

    /// Prints and saves what was asked for; warnings and what has no place in a machine-readable
    /// answer go to standard error.
    pub(super) fn emit(&self, presentation: &Presentation) -> anyhow::Result<()> {
        let Presentation { title, notes, warnings, json, tables, figures } = presentation;
        if let (Some(path), Some(figure)) = (&self.plot, figures.first()) {
            figure.save(path)?;
        }
        if let Some(path) = &self.report {
            let report = Report {
                title: title.clone(),
                notes: notes.clone(),
                warnings: warnings.clone(),
                tables: tables.clone(),
                figures: figures.clone(),
            };
            write_html(path, &report)?;
        }
        let first = tables.first().map(|(_, table)| table);
        let machine = match first {
            _ if self.json => Some(serde_json::to_string_pretty(json)?),
            Some(table) if self.csv => Some(table.to_csv()),
            Some(table) if self.latex => Some(table.to_latex()),
            _ => None,
        };
        for warning in warnings {
            tell(&format!("warning: {warning}"));
        }
        let text = match machine {
            Some(text) => {
                notes.iter().for_each(|note| tell(note));
                text
            }
            None => {
                let mut text = format!("{title}\n{}\n", notes.join("\n"));
                for (heading, table) in tables {
                    text.push_str(&format!("\n{heading}\n{}", table.to_text()));
                }
                text
            }
        };
        print(&text)
    }
}
