//! Tables in text files as people and programs write them: separators, decimal signs, units of
//! time.

use std::borrow::Cow;

/// What stands between the fields of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Separator {
    /// Blanks and tabs, any number of them.
    Blanks,
    Commas,
    Semicolons,
}

/// How the lines of one table are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dialect {
    pub separator: Separator,
    /// Whether a comma stands for the decimal point.
    pub decimal_comma: bool,
}

impl Dialect {
    /// Of the table that holds `line`. A comma is a decimal one beside semicolons, and in a first
    /// word such as `12,5`.
    pub fn of(line: &str) -> Self {
        let is_decimal = |word: &str| {
            let (whole, fraction) = word.split_once(',').unwrap_or_default();
            let digits = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
            digits(whole.trim_start_matches(['-', '+'])) && digits(fraction)
        };
        let mut words = line.split_whitespace();
        if line.contains(';') {
            Self { separator: Separator::Semicolons, decimal_comma: line.contains(',') }
        } else if words.next().is_some_and(is_decimal) && words.next().is_some() {
            Self { separator: Separator::Blanks, decimal_comma: true }
        } else if line.contains(',') {
            Self { separator: Separator::Commas, decimal_comma: false }
        } else {
            Self { separator: Separator::Blanks, decimal_comma: false }
        }
    }

    /// The fields of a line, without blanks and quotes around them.
    pub fn fields<'a>(&self, line: &'a str) -> impl Iterator<Item = &'a str> + Clone + use<'a> {
        let separator = self.separator;
        let is_separator = move |c: char| match separator {
            Separator::Blanks => c.is_whitespace(),
            Separator::Commas => c == ',',
            Separator::Semicolons => c == ';',
        };
        line.split(is_separator)
            .filter(move |field| separator != Separator::Blanks || !field.is_empty())
            .map(|field| field.trim().trim_matches('"'))
    }

    /// The names of columns that a line holds. Between blanks, a unit in brackets, `time [ns]`,
    /// is part of the name before it.
    pub fn names(&self, line: &str) -> Vec<String> {
        let is_open = |name: &str| name.rfind(['[', '(']) > name.rfind([']', ')']);
        let mut names: Vec<String> = Vec::new();
        for field in self.fields(line) {
            let is_unit = field.starts_with(['[', '(']) || names.last().is_some_and(|n| is_open(n));
            match names.last_mut() {
                Some(name) if is_unit && self.separator == Separator::Blanks => {
                    name.push(' ');
                    name.push_str(field);
                }
                _ => names.push(field.to_owned()),
            }
        }
        names
    }

    /// The field as programs write numbers.
    pub fn plain<'a>(&self, field: &'a str) -> Cow<'a, str> {
        match self.decimal_comma {
            true => Cow::Owned(field.replacen(',', ".", 1)),
            false => Cow::Borrowed(field),
        }
    }

    /// The number in a field, which may be NaN or infinite; `None` if there is none.
    pub fn number(&self, field: &str) -> Option<f64> {
        self.plain(field).parse().ok()
    }
}

/// Unit of the stamps of a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimeUnit {
    Seconds,
    Nanoseconds,
}

/// Whole numbers from here on are no seconds (the year 5138) but nanoseconds of an epoch clock, or
/// of a device that has run for two minutes.
const NANOSECONDS_FROM: i64 = 100_000_000_000;

impl TimeUnit {
    /// What a column's name says: `#timestamp [ns]`, `t_ns`.
    pub fn of_name(name: &str) -> Option<Self> {
        if name.starts_with('%') {
            // `rostopic echo -p`
            return Some(Self::Nanoseconds);
        }
        let words = name.to_lowercase();
        let unit = words.rsplit(|c: char| !c.is_alphanumeric()).find(|word| !word.is_empty())?;
        match unit {
            "s" | "sec" | "seconds" => Some(Self::Seconds),
            "ns" | "nsec" | "nanoseconds" => Some(Self::Nanoseconds),
            _ => None,
        }
    }

    /// What the stamp itself says: a whole number of eleven digits is in nanoseconds.
    pub fn of_stamp(field: &str) -> Self {
        match field.parse::<i64>() {
            Ok(whole) if whole.abs() >= NANOSECONDS_FROM => Self::Nanoseconds,
            _ => Self::Seconds,
        }
    }
}

/// What a column is, by its name: the axis (`x`, `y`, `z`, `w`), the rest of the name in lower
/// case, units in brackets left out.
pub fn axis_of(name: &str) -> Option<(char, String)> {
    let name = name.split(['[', '(']).next()?.trim().to_lowercase();
    let axis = name.chars().last().filter(|c| ('w'..='z').contains(c))?;
    let stem = name[..name.len() - axis.len_utf8()].trim_end_matches(['_', '.', ' ']);
    Some((axis, stem.to_owned()))
}

/// Whether a column of this name holds the time.
pub fn is_stamp(name: &str) -> bool {
    let name = name.split(['[', '(']).next().unwrap_or_default().trim().to_lowercase();
    let plain = name.trim_start_matches('%').trim_end_matches("_ns").trim_end_matches("_s");
    ["t", "time", "timestamp", "stamp"].contains(&plain)
}

/// Where the parts of a pose stand in a line, by the names of the columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PoseColumns {
    /// Of stamp, position (x, y, z) and quaternion (x, y, z, w).
    pub columns: [usize; 8],
    /// What the name of the first says.
    pub unit: Option<TimeUnit>,
}

impl PoseColumns {
    /// If `line`, perhaps behind a `#`, names every one of them, and once.
    pub fn named(line: &str) -> Option<Self> {
        const POSITION: [&str; 8] =
            ["", "t", "p", "pos", "position", "translation", "p_rs_r", "p_wi"];
        let line = line.trim_start_matches(['#', ' ']);
        let (mut columns, mut unit) = ([None; 8], None);
        for (index, name) in Dialect::of(line).names(line).iter().enumerate() {
            let role = match axis_of(name) {
                Some((axis, stem)) => {
                    let axis = ['x', 'y', 'z', 'w'].into_iter().position(|a| a == axis)?;
                    let is_position = POSITION.contains(&stem.as_str()) && axis < 3;
                    let is_quaternion = stem.starts_with('q') || stem.contains("orientation");
                    is_position.then_some(1 + axis).or(is_quaternion.then_some(4 + axis))
                }
                None => is_stamp(name).then_some(0),
            };
            let Some(role) = role else { continue };
            if columns[role].replace(index).is_some() {
                return None;
            }
            if role == 0 {
                unit = TimeUnit::of_name(name);
            }
        }
        let columns: Vec<usize> = columns.into_iter().collect::<Option<_>>()?;
        Some(Self { columns: columns.try_into().ok()?, unit })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(line: &str) -> Vec<f64> {
        let dialect = Dialect::of(line);
        dialect.fields(line).map(|field| dialect.number(field).unwrap_or(f64::NAN)).collect()
    }

    #[test]
    fn one_line_in_every_spelling() {
        for line in [
            "12.5 -.5 3 4e-1",
            "12.5\t-.5\t\t3  4e-1",
            "12.5,-.5,3,4e-1",
            "12.5, -0.5, 3, 0.4",
            "\"12.5\",\"-.5\",\"3\",\"0.4\"",
            "12.5;-.5;3;0.4",
            "12,5;-,5;3;0,4",
            "12,5 -,5 3 0,4",
            "12,5\t-0,5\t3\t4e-1",
        ] {
            assert_eq!(numbers(line), [12.5, -0.5, 3.0, 0.4], "{line}");
        }
    }

    #[test]
    fn empty_fields_and_thousands_are_no_numbers() {
        assert!(numbers("1,2,,4")[2].is_nan());
        assert!(numbers("1;2;;4")[2].is_nan());
        assert!(numbers("1.234,5;2")[0].is_nan());
        // Commas that separate and commas in numbers cannot be told apart.
        assert_eq!(numbers("1,5,2,5").len(), 4);
    }

    #[test]
    fn units_belong_to_the_names_of_their_columns() {
        let names = |line: &str| Dialect::of(line).names(line);
        let expected = ["t [ns]", "w_x [rad s^-1]", "a_x (m/s^2)", "n"];
        for separator in [" ", ",", ";"] {
            assert_eq!(names(&expected.join(separator)), expected, "{separator}");
        }
        let poses = |line: &str| PoseColumns::named(line).map(|pose| pose.columns);
        let units = poses("# t [s] x [m] y [m] z [m] qx qy qz qw");
        assert_eq!(units, Some([0, 1, 2, 3, 4, 5, 6, 7]));
    }

    #[test]
    fn units_of_time_and_axes() {
        for (name, unit) in [
            ("#timestamp [ns]", Some(TimeUnit::Nanoseconds)),
            ("t_ns", Some(TimeUnit::Nanoseconds)),
            ("%time", Some(TimeUnit::Nanoseconds)),
            ("time (s)", Some(TimeUnit::Seconds)),
            ("timestamp", None),
        ] {
            assert_eq!(TimeUnit::of_name(name), unit, "{name}");
        }
        assert_eq!(TimeUnit::of_stamp("1403715524907143168"), TimeUnit::Nanoseconds);
        assert_eq!(TimeUnit::of_stamp("1403715524"), TimeUnit::Seconds);
        assert_eq!(TimeUnit::of_stamp("1403715524.907"), TimeUnit::Seconds);
        let axis = |name| axis_of(name).map(|(axis, stem)| format!("{stem}|{axis}"));
        assert_eq!(axis(" p_RS_R_x [m]").as_deref(), Some("p_rs_r|x"));
        assert_eq!(axis("field.angular_velocity.z").as_deref(), Some("field.angular_velocity|z"));
        assert_eq!((axis("qw").as_deref(), axis("time")), (Some("q|w"), None));
    }
}
