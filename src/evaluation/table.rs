use std::fmt::Write;

/// A table of results: text for people, CSV for programs, LaTeX for papers.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Table {
    pub columns: Vec<String>,
    pub rows: Vec<Vec<Cell>>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Cell {
    Text(String),
    Count(usize),
    /// Shown with six decimals, written to CSV in full.
    Number(f64),
    /// Nothing to report.
    Missing,
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}

impl From<String> for Cell {
    fn from(text: String) -> Self {
        Self::Text(text)
    }
}

impl From<usize> for Cell {
    fn from(count: usize) -> Self {
        Self::Count(count)
    }
}

impl From<f64> for Cell {
    fn from(number: f64) -> Self {
        Self::Number(number)
    }
}

impl<T: Into<Cell>> From<Option<T>> for Cell {
    fn from(value: Option<T>) -> Self {
        value.map_or(Self::Missing, Into::into)
    }
}

impl Cell {
    /// As people read it.
    pub fn display(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Count(count) => count.to_string(),
            Self::Number(number) => format!("{number:.6}"),
            Self::Missing => "-".to_owned(),
        }
    }

    fn is_text(&self) -> bool {
        matches!(self, Self::Text(_))
    }
}

impl Table {
    pub fn new<const N: usize>(columns: [&str; N]) -> Self {
        Self { columns: columns.map(str::to_owned).to_vec(), rows: Vec::new() }
    }

    /// A row of cells of one kind.
    pub fn push<T: Into<Cell>, const N: usize>(&mut self, row: [T; N]) {
        self.rows.push(row.map(Into::into).into());
    }

    /// Columns padded with blanks, numbers to the right.
    pub fn to_text(&self) -> String {
        let cells: Vec<Vec<String>> =
            self.rows.iter().map(|row| row.iter().map(Cell::display).collect()).collect();
        let width = |column: usize| {
            let in_rows = cells.iter().filter_map(|row| row.get(column));
            let names = self.columns.get(column).into_iter();
            in_rows.chain(names).map(|text| text.chars().count()).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..self.columns.len()).map(width).collect();
        let left: Vec<bool> = (0..self.columns.len())
            .map(|c| self.rows.iter().filter_map(|row| row.get(c)).any(Cell::is_text))
            .collect();
        let mut out = String::new();
        for row in std::iter::once(&self.columns).chain(&cells) {
            let mut line = String::new();
            for ((text, width), left) in row.iter().zip(&widths).zip(&left) {
                let padding = " ".repeat(width.saturating_sub(text.chars().count()));
                let (before, after) =
                    if *left { ("", padding.as_str()) } else { (padding.as_str(), "") };
                line.push_str(&format!("{before}{text}{after}  "));
            }
            out.push_str(line.trim_end());
            out.push('\n');
        }
        out
    }

    /// RFC 4180, numbers with all their digits.
    pub fn to_csv(&self) -> String {
        let quote = |text: &str| {
            if text.contains([',', '"', '\n', '\r']) {
                format!("\"{}\"", text.replace('"', "\"\""))
            } else {
                text.to_owned()
            }
        };
        let cell = |cell: &Cell| match cell {
            Cell::Text(text) => quote(text),
            Cell::Count(count) => count.to_string(),
            Cell::Number(number) => number.to_string(),
            Cell::Missing => String::new(),
        };
        let mut lines = vec![self.columns.iter().map(|c| quote(c)).collect::<Vec<_>>().join(",")];
        lines.extend(self.rows.iter().map(|r| r.iter().map(cell).collect::<Vec<_>>().join(",")));
        lines.join("\n") + "\n"
    }

    /// A `tabular` with the rules of the package booktabs.
    pub fn to_latex(&self) -> String {
        let column = |c: usize| {
            let text = self.rows.iter().filter_map(|row| row.get(c)).any(Cell::is_text);
            if text { 'l' } else { 'r' }
        };
        let layout: String = (0..self.columns.len()).map(column).collect();
        let line = |cells: Vec<String>| format!("  {} \\\\\n", cells.join(" & "));
        let mut out = format!("\\begin{{tabular}}{{{layout}}}\n  \\toprule\n");
        out.push_str(&line(self.columns.iter().map(|name| latex_escaped(name)).collect()));
        out.push_str("  \\midrule\n");
        for row in &self.rows {
            out.push_str(&line(row.iter().map(|cell| latex_escaped(&cell.display())).collect()));
        }
        out.push_str("  \\bottomrule\n\\end{tabular}\n");
        out
    }

    /// An HTML `table`.
    pub fn to_html(&self) -> String {
        let mut out = String::from("<table>\n<tr>");
        let class = |cell: &Cell| if cell.is_text() { "text" } else { "number" };
        for (index, name) in self.columns.iter().enumerate() {
            let class = self.rows.first().and_then(|row| row.get(index)).map_or("number", class);
            // Writing to a string cannot fail.
            let _ = write!(out, "<th class=\"{class}\">{}</th>", html_escaped(name));
        }
        out.push_str("</tr>\n");
        for row in &self.rows {
            out.push_str("<tr>");
            for cell in row {
                let text = html_escaped(&cell.display());
                let _ = write!(out, "<td class=\"{}\">{text}</td>", class(cell));
            }
            out.push_str("</tr>\n");
        }
        out.push_str("</table>\n");
        out
    }
}

fn latex_escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => {
                out.push('\\');
                out.push(c);
            }
            '~' => out.push_str("\\textasciitilde{}"),
            '^' => out.push_str("\\textasciicircum{}"),
            '\\' => out.push_str("\\textbackslash{}"),
            _ => out.push(c),
        }
    }
    out
}

pub(super) fn html_escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        let mut table = Table::new(["file", "rmse (m)", "matched"]);
        table.rows.push(vec!["lab_1, a".into(), 0.125.into(), 333_usize.into()]);
        table.rows.push(vec!["b".into(), Cell::Missing, 5_usize.into()]);
        table
    }

    #[test]
    fn text_is_aligned() {
        assert_eq!(
            table().to_text(),
            "file      rmse (m)  matched\nlab_1, a  0.125000      333\nb                -        5\n"
        );
    }

    #[test]
    fn csv_quotes_and_keeps_all_digits() {
        let mut table = table();
        table.rows[1][1] = Cell::Number(1.0 / 3.0);
        assert_eq!(
            table.to_csv(),
            "file,rmse (m),matched\n\"lab_1, a\",0.125,333\nb,0.3333333333333333,5\n"
        );
    }

    #[test]
    fn latex_and_html_escape() {
        assert!(table().to_latex().contains("  lab\\_1, a & 0.125000 & 333 \\\\\n"));
        assert!(table().to_latex().starts_with("\\begin{tabular}{lrr}\n"));
        let mut table = table();
        table.rows[0][0] = "a<b".into();
        assert!(table.to_html().contains("<td class=\"text\">a&lt;b</td>"));
    }
}
