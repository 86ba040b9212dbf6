//! Text tables line by line, for the readers of inertial data and of position fixes.

use std::fs::File;
use std::io::{BufRead, BufReader, Lines};
use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use super::LogError;
use crate::sensor::Stamp;

/// The lines of a file.
#[derive(Debug)]
pub(super) struct TextTable {
    path: PathBuf,
    lines: Lines<BufReader<File>>,
    number: usize,
}

impl TextTable {
    /// # Errors
    /// [`LogError::Io`] if the file cannot be opened.
    pub fn open(path: &Path) -> Result<Self, LogError> {
        let file =
            File::open(path).map_err(|source| LogError::Io { path: path.to_path_buf(), source })?;
        Ok(Self { path: path.to_path_buf(), lines: BufReader::new(file).lines(), number: 0 })
    }

    /// The next line that is not empty, without blanks around it.
    pub fn next_line(&mut self) -> Result<Option<String>, LogError> {
        for line in self.lines.by_ref() {
            self.number += 1;
            let line = line.map_err(|error| match error.kind() {
                std::io::ErrorKind::InvalidData => corrupt(&self.path, self.number, "not text"),
                _ => LogError::Io { path: self.path.clone(), source: error },
            })?;
            let line = line.trim_start_matches('\u{feff}').trim();
            if !line.is_empty() {
                return Ok(Some(line.to_owned()));
            }
        }
        Ok(None)
    }

    /// Number of the last line.
    pub fn line_number(&self) -> usize {
        self.number
    }

    /// The error that the last line is wrong.
    pub fn wrong_line(&self, reason: &str) -> LogError {
        corrupt(&self.path, self.number, reason)
    }
}

fn corrupt(path: &Path, line: usize, reason: &str) -> LogError {
    LogError::Corrupt { path: path.to_path_buf(), reason: format!("line {line}: {reason}") }
}

/// Fields of a line, separated by commas or semicolons or, without these, by blanks.
pub(super) fn fields(line: &str) -> Vec<&str> {
    if line.contains([',', ';']) {
        line.split([',', ';']).map(str::trim).collect()
    } else {
        line.split_whitespace().collect()
    }
}

/// The fields of a line, by their columns.
pub(super) struct Row<'a>(pub &'a [&'a str]);

impl<'a> Row<'a> {
    pub fn field(&self, column: usize) -> Result<&'a str, String> {
        self.0.get(column).copied().ok_or_else(|| format!("{} fields are too few", self.0.len()))
    }

    pub fn stamp(&self, column: usize) -> Result<Stamp, String> {
        let text = self.field(column)?;
        Stamp::parse_seconds(text).ok_or_else(|| format!("`{text}` is no time in s"))
    }

    /// Three numbers, among which may be NaN and infinite ones.
    pub fn vector(&self, columns: [usize; 3]) -> Result<Vector3<f64>, String> {
        let mut vector = Vector3::zeros();
        for (value, column) in vector.iter_mut().zip(columns) {
            let text = self.field(column)?;
            *value = text.parse().map_err(|_| format!("`{text}` is no number"))?;
        }
        Ok(vector)
    }
}
