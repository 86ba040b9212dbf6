//! The distributions from the command line: `fisher`, and the studies of chapter 2.

mod support;

use serde_json::Value;
use support::{json, lines, mfg_vio, recording, succeed, text};

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("an array").iter().filter_map(Value::as_f64).collect()
}

/// Standard error of a run that fails with `code` and prints nothing else.
#[track_caller]
fn failure(arguments: &[&str], code: i32) -> String {
    let output = mfg_vio(arguments);
    assert_eq!(output.status.code(), Some(code), "{arguments:?}");
    assert!(output.stdout.is_empty());
    String::from_utf8(output.stderr).expect("UTF-8")
}

#[test]
fn fisher_agrees_with_the_reference_to_its_digits() {
    let Some(reference) = recording("matrix_fisher/second_moments.csv") else { return };
    let lines: Vec<String> =
        lines(&reference).into_iter().filter(|line| !line.starts_with('#')).collect();
    let names: Vec<&str> = lines[0].split(',').skip(3).collect();
    for line in &lines[1..] {
        let row: Vec<&str> = line.split(',').collect();
        let found = json(&["fisher", row[0], row[1], row[2], "--json"]);
        let second = found["second"].as_object().expect("an object");
        assert_eq!(second.len(), names.len());
        for (name, printed) in names.iter().zip(&row[3..]) {
            let value: f64 = printed.parse().expect("a number");
            let found = second[*name].as_f64().expect("a number");
            assert!((found - value).abs() < 1e-10, "{line} {name} {found}");
        }
    }
}

#[test]
fn fisher_inverts_its_own_moments() {
    for s in [["20", "5", "-1"], ["7", "7", "-7"], ["3e1", "3e1", "3e1"], ["0", "0", "0"]] {
        let forward = json(&["fisher", s[0], s[1], s[2], "--json"]);
        let first: Vec<String> = numbers(&forward["first"]).iter().map(f64::to_string).collect();
        let mut arguments = vec!["fisher", "--json", "--moments"];
        arguments.extend(first.iter().map(String::as_str));
        let back = json(&arguments);
        for (found, expected) in numbers(&back["s"]).iter().zip(s) {
            let expected: f64 = expected.parse().expect("a number");
            assert!((found - expected).abs() < 1e-9 * (1.0 + expected.abs()), "{s:?} {back}");
        }
        let difference = forward["log_c"].as_f64().unwrap() - back["log_c"].as_f64().unwrap();
        assert!(difference.abs() < 1e-9);
    }
}

#[test]
fn fisher_prints_what_is_asked_of_it() {
    let uniform = succeed(&["fisher", "0", "0", "0"]);
    // sqrt(pi^2/3 + 2) rad.
    assert!(uniform.contains("131.778"), "{uniform}");
    assert!(uniform.contains("uniform"), "{uniform}");
    let free = succeed(&["fisher", "30", "-0", "0"]);
    assert!(free.contains("any turn about axis 1"), "{free}");
}

#[test]
fn what_is_no_distribution_is_refused_in_one_line() {
    for (arguments, code, reason) in [
        (&["fisher", "1", "2", "3"][..], 1, "s1 >= s2 >= |s3|"),
        (&["fisher", "nan", "0", "0"][..], 1, "s1 >= s2 >= |s3|"),
        (&["fisher", "--moments", "0.9", "0.9", "0.7"][..], 1, "1 - d1 - d2 + d3 must be positive"),
        (&["fisher", "--moments", "1", "1", "1"][..], 1, "1 - d1 - d2 + d3 must be positive"),
        (&["fisher", "--moments", "0.1", "0.2", "-0.3"][..], 1, "d1 >= d2 >= |d3|"),
        (&["experiment", "wang-2.2"][..], 1, "wang-2.1"),
    ] {
        let error = failure(arguments, code);
        assert!(error.contains(reason) && error.lines().count() == 1, "{error}");
    }
    for arguments in [&["fisher", "1", "0"][..], &["fisher"], &["fisher", "--moments", "1", "0"]] {
        failure(arguments, 2);
    }
}

#[test]
fn a_study_writes_its_report_and_its_figure() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let report = json(&["experiment", "wang-fig-2.4", "--out", text(directory.path()), "--json"]);
    assert_eq!(report["name"], "wang-fig-2.4");
    let rows = report["rows"].as_array().expect("rows");
    assert!(rows.iter().any(|row| row["case"] == "s=100" && row["filter"] == "exact"));
    let written = |extension: &str| directory.path().join(format!("wang-fig-2.4.{extension}"));
    let svg = std::fs::read_to_string(written("svg")).expect("an SVG");
    assert!(svg.starts_with("<svg") && svg.contains("saddle point"));
    let png = std::fs::read(written("png")).expect("a PNG");
    assert!(png.starts_with(b"\x89PNG"));
    let file: Value = serde_json::from_slice(&std::fs::read(written("json")).expect("a report"))
        .expect("one JSON object");
    assert_eq!(file, report);
}

#[test]
fn table_2_1_is_that_of_the_samples_it_was_given() {
    let report = json(&["experiment", "wang-2.1", "--runs", "2000", "--seed", "3", "--json"]);
    assert_eq!((report["runs"].as_u64(), report["seed"].as_u64()), (Some(2000), Some(3)));
    let rows = report["rows"].as_array().expect("rows");
    assert!(rows.iter().any(|row| row["case"] == "S=25,10,-5" && row["paper"] == 0.004));
}
