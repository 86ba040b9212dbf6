//! Self-contained HTML: tables and plots in one file that can be mailed.

use std::fmt::Write;
use std::path::Path;

use super::table::html_escaped;
use super::{Figure, PlotError, Table};
use crate::output;

/// What a report shows, in this order.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Report {
    pub title: String,
    /// Paragraphs above the tables: what was compared, and how.
    pub notes: Vec<String>,
    /// Shown so that they cannot be overlooked.
    pub warnings: Vec<String>,
    /// Headings and tables.
    pub tables: Vec<(String, Table)>,
    pub figures: Vec<Figure>,
}

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:1320px;margin:2em auto;\
padding:0 1em;color:#222}h1{font-size:1.5em}h2{font-size:1.15em;margin-top:1.6em}\
table{border-collapse:collapse;font-variant-numeric:tabular-nums}\
th,td{padding:.2em .8em;border-bottom:1px solid #ddd;text-align:right}\
td.text,th.text{text-align:left}.warning{background:#fff3cd;padding:.4em .8em;margin:.3em 0}\
figure{margin:1em 0}svg{max-width:100%;height:auto}";

/// Writes `report` as one HTML file without references to others.
pub fn write_html(path: &Path, report: &Report) -> Result<(), PlotError> {
    output::write(path, to_html(report)?)
        .map_err(|error| PlotError::Io { path: path.to_owned(), error })
}

fn to_html(report: &Report) -> Result<String, PlotError> {
    let title = html_escaped(&report.title);
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" content=\"width=device-width\">\n<title>{title}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<h1>{title}</h1>\n"
    );
    // Writing to a string cannot fail.
    for note in &report.notes {
        let _ = writeln!(html, "<p>{}</p>", html_escaped(note));
    }
    for warning in &report.warnings {
        let _ = writeln!(html, "<p class=\"warning\">{}</p>", html_escaped(warning));
    }
    for (heading, table) in &report.tables {
        let _ = write!(html, "<h2>{}</h2>\n{}", html_escaped(heading), table.to_html());
    }
    for figure in &report.figures {
        let _ = writeln!(html, "<figure>\n{}\n</figure>", figure.to_svg()?);
    }
    html.push_str("</body>\n</html>\n");
    Ok(html)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::{counts_figure, stage_times_figure};

    #[test]
    fn a_report_holds_everything_and_refers_to_nothing() {
        let stamps: Vec<f64> = (0..50).map(|i| 100.0 + 0.1 * f64::from(i)).collect();
        let counts =
            counts_figure(&stamps, &[("features", vec![300.0; 50]), ("inliers", vec![80.0; 50])]);
        let times = stage_times_figure(&[("ransac", vec![0.001, 0.002, 0.004])]);
        let mut table = Table::new(["file", "rmse"]);
        table.rows.push(vec!["a & b".into(), 0.5.into()]);
        let report = Report {
            title: "Run <1>".to_owned(),
            notes: vec!["se3 alignment".to_owned()],
            warnings: vec!["scale 0.5".to_owned()],
            tables: vec![("Errors".to_owned(), table)],
            figures: vec![counts, times],
        };
        let html = to_html(&report).unwrap();
        for part in
            ["Run &lt;1&gt;", "se3 alignment", "scale 0.5", "a &amp; b", "inliers", "ransac"]
        {
            assert!(html.contains(part), "{part}");
        }
        assert_eq!(html.matches("<svg").count(), 2);
        assert!(!html.contains("href=") && !html.contains("src="));
    }
}
