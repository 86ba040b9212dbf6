//! Text tables line by line, for the readers of inertial data and of position fixes.

use std::fs::File;
use std::io::{BufRead, BufReader, Lines};
use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use super::LogError;
use crate::dialect::{Dialect, TimeUnit};
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

/// The fields of a line, by their columns.
pub(super) struct Row<'a> {
    fields: Vec<&'a str>,
    dialect: Dialect,
    /// Of the stamps.
    unit: TimeUnit,
}

impl<'a> Row<'a> {
    pub fn new(line: &'a str, dialect: Dialect, unit: TimeUnit) -> Self {
        Self { fields: dialect.fields(line).collect(), dialect, unit }
    }

    pub fn len(&self) -> usize {
        self.fields.len()
    }

    pub fn field(&self, column: usize) -> Result<&'a str, String> {
        let field = self.fields.get(column).copied();
        field.ok_or_else(|| format!("{} fields are too few", self.len()))
    }

    pub fn stamp(&self, column: usize) -> Result<Stamp, String> {
        stamp(self.field(column)?, self.dialect, self.unit)
    }

    /// Three numbers, among which may be NaN and infinite ones.
    pub fn vector(&self, columns: [usize; 3]) -> Result<Vector3<f64>, String> {
        let mut vector = Vector3::zeros();
        for (value, column) in vector.iter_mut().zip(columns) {
            let text = self.field(column)?;
            *value = self.dialect.number(text).ok_or_else(|| format!("`{text}` is no number"))?;
        }
        Ok(vector)
    }
}

/// The stamp in a field; whole nanoseconds keep every digit.
pub(super) fn stamp(field: &str, dialect: Dialect, unit: TimeUnit) -> Result<Stamp, String> {
    let stamp = match unit {
        TimeUnit::Nanoseconds => field.parse().ok().map(Stamp::from_nanos),
        TimeUnit::Seconds => Stamp::parse_seconds(&dialect.plain(field)),
    };
    stamp.ok_or_else(|| match unit {
        TimeUnit::Nanoseconds => format!("`{field}` is no time in whole ns"),
        TimeUnit::Seconds => format!("`{field}` is no time in s"),
    })
}

/// Rows of a log are not a day apart, s.
const LONGEST_STEP: f64 = 86_400.0;

/// Refuses a stamp that cannot be in the unit of the one before it.
pub(super) fn check_step(previous: Option<Stamp>, stamp: Stamp) -> Result<(), String> {
    match previous.map(|previous| stamp.seconds_since(previous).abs()) {
        Some(step) if step > LONGEST_STEP => Err(format!(
            "{step:.0} s from the line before: stamps are in s, or in ns where the name of their \
             column says so (`t_ns`) or they have 12 digits"
        )),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_keep_their_digits_or_are_refused() {
        let read = |field: &str, unit| {
            let dialect = Dialect::of("0,5;1");
            stamp(field, dialect, unit).map(Stamp::nanos)
        };
        let nanos = "1403715524907143168";
        assert_eq!(read(nanos, TimeUnit::Nanoseconds), Ok(1_403_715_524_907_143_168));
        assert_eq!(read("1403715524,907", TimeUnit::Seconds), Ok(1_403_715_524_907_000_000));
        assert_eq!(read("-,5", TimeUnit::Seconds), Ok(-500_000_000));
        for (field, unit) in [
            (nanos, TimeUnit::Seconds),
            ("1.40372e+18", TimeUnit::Nanoseconds),
            ("14037155249071431680", TimeUnit::Nanoseconds),
            ("nan", TimeUnit::Seconds),
            ("", TimeUnit::Seconds),
        ] {
            assert!(read(field, unit).is_err(), "{field}");
        }
    }
}
