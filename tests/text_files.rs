//! Text files as people and programs write them: read right, or refused with line and reason.

mod support;

use std::path::Path;
use std::process::Command;

use serde_json::Value;
use support::{fail, json, mfg_vio, succeed, text};

/// Rows `t x y z qx qy qz qw` of a curve with turns.
fn rows(position: impl Fn(f64) -> [f64; 3]) -> Vec<[f64; 8]> {
    let row = |i: u32| {
        let t = f64::from(i) * 0.05;
        let [x, y, z] = position(t);
        let half = 0.3 * (0.8 * t).sin();
        [1000.0 + t, x, y, z, 0.0, 0.6 * half.sin(), 0.8 * half.sin(), half.cos()]
    };
    (0..200).map(row).collect()
}

fn tum(rows: &[[f64; 8]], separator: &str) -> String {
    let line = |row: &[f64; 8]| row.map(|x| format!("{x:.9}")).join(separator) + "\n";
    rows.iter().map(line).collect()
}

/// Reproducible numbers between -0.5 and 0.5.
fn noise(seed: usize) -> f64 {
    let wave = (seed as f64 * 12.9898).sin() * 43_758.545_3;
    wave - wave.floor() - 0.5
}

fn write(folder: &Path, name: &str, content: impl AsRef<[u8]>) -> String {
    let path = folder.join(name);
    std::fs::write(&path, content).unwrap();
    text(&path).to_owned()
}

fn curve(t: f64) -> [f64; 3] {
    [2.0 * t.sin(), 1.5 * (0.7 * t).cos(), 0.4 * (1.3 * t).sin()]
}

#[test]
fn one_trajectory_in_every_spelling_has_no_error() {
    let folder = tempfile::tempdir().unwrap();
    let rows = rows(curve);
    let plain = tum(&rows, " ");
    let reference = write(folder.path(), "ref.txt", &plain);
    let nanoseconds: String = rows
        .iter()
        .map(|row| {
            let nanos = (row[0] * 1e9).round();
            let rest = tum(&[*row], " ").split_once(' ').unwrap().1.to_owned();
            format!("{nanos:.0} {rest}")
        })
        .collect();
    let euroc: String = rows
        .iter()
        .map(|[t, x, y, z, i, j, k, w]| {
            format!("{:.0},{w:.9},{i:.9},{j:.9},{k:.9},{x:.9},{y:.9},{z:.9}\n", t * 1e9)
        })
        .collect();
    let header = "#timestamp [ns],q_w,q_x,q_y,q_z,p_x,p_y,p_z\n".replace("p_", "position_");
    let spellings = [
        plain.replace('\n', "\r\n"),
        format!("\u{feff}{plain}"),
        tum(&rows, ","),
        tum(&rows, ";"),
        tum(&rows, ";").replace('.', ","),
        tum(&rows, "\t").replace('.', ","),
        plain.replace(" 0.", " .").replace(" -0.", " -."),
        nanoseconds,
        format!("{header}{euroc}"),
        tum(&rows.iter().rev().copied().collect::<Vec<_>>(), " "),
        plain.lines().map(|line| format!("{line}\n{line}\n")).collect(),
    ];
    for (n, spelling) in spellings.iter().enumerate() {
        let estimate = write(folder.path(), &format!("est{n}.txt"), spelling);
        for relation in ["trans", "angle"] {
            let answer =
                json(&["evaluate", "ape", &reference, &estimate, "--relation", relation, "--json"]);
            let rmse = answer["rmse"].as_f64().unwrap();
            assert!(rmse < 1e-5 && answer["matched"] == 200, "{n} {relation}: {answer}");
        }
    }
}

#[test]
fn the_file_that_is_wrong_is_named_with_its_line() {
    let folder = tempfile::tempdir().unwrap();
    let plain = tum(&rows(curve), " ");
    let good = write(folder.path(), "good.txt", &plain);
    let broken = |line: usize, from: &str, to: &str| {
        let mut lines: Vec<String> = plain.lines().map(str::to_owned).collect();
        lines[line - 1] = lines[line - 1].replacen(from, to, 1);
        lines.join("\n")
    };
    let same = plain.lines().map(|line| format!("1.40372e+09 {}", line.split_once(' ').unwrap().1));
    for (content, expected) in [
        (broken(7, "1000.3", "nan"), "line 7"),
        (broken(9, "1000.4", "1000.4 7"), "line 9"),
        (broken(5, "1000.2", "1403715524907143168"), "line 5"),
        (same.collect::<Vec<_>>().join("\n"), "line 2"),
        (String::new(), "no poses"),
    ] {
        let bad = write(folder.path(), "bad.txt", &content);
        for files in [[&good, &bad], [&bad, &good]] {
            let errors = fail(&["evaluate", "ape", files[0], files[1]]);
            assert_eq!(errors.lines().count(), 1, "{errors}");
            assert!(errors.contains("bad.txt") && !errors.contains("good.txt"), "{errors}");
            assert!(errors.contains(expected), "{errors}");
        }
    }
    let utf16: Vec<u8> =
        [0xff, 0xfe].into_iter().chain(plain.bytes().flat_map(|byte| [byte, 0])).collect();
    let utf16 = write(folder.path(), "utf16.txt", utf16);
    assert!(fail(&["evaluate", "ape", &utf16, &good]).contains("UTF-8"));
    // What lies between two files names both.
    let mut later = rows(curve);
    later.iter_mut().for_each(|row| row[0] += 5000.0);
    let later = tum(&later, " ");
    let later = write(folder.path(), "later.txt", later);
    let errors = fail(&["evaluate", "ape", &good, &later]);
    assert!(errors.contains("good.txt") && errors.contains("later.txt"), "{errors}");
}

/// Equal attitudes have no error, whatever the positions say of the alignment.
#[test]
fn the_alignment_invents_no_attitude_error() {
    let folder = tempfile::tempdir().unwrap();
    let still = |_: f64| [1.0, 2.0, 3.0];
    let along = |t: f64| [0.2 * t, 0.1 * t, 0.0];
    let upwards = |t: f64| [0.0, 0.0, 0.3 * t];
    let shapes: [&dyn Fn(f64) -> [f64; 3]; 3] = [&still, &along, &upwards];
    for (shape, sigma) in shapes.iter().flat_map(|s| [0.0, 1e-4, 1e-2].map(|sigma| (s, sigma))) {
        let exact = rows(shape);
        let disturbed = |seed: usize| -> Vec<[f64; 8]> {
            let mut rows = exact.clone();
            for (n, row) in rows.iter_mut().enumerate() {
                for (k, coordinate) in row.iter_mut().enumerate().skip(1).take(3) {
                    *coordinate += sigma * noise(seed + 7 * n + k);
                }
            }
            rows
        };
        let reference = write(folder.path(), "ref.txt", tum(&disturbed(1), " "));
        let estimate = write(folder.path(), "est.txt", tum(&disturbed(5000), " "));
        for align in ["se3", "yaw"] {
            let answer = json(&[
                "evaluate",
                "ape",
                &reference,
                &estimate,
                "--relation",
                "angle",
                "--align",
                align,
                "--json",
            ]);
            let rmse = answer["rmse"].as_f64().unwrap();
            assert!(rmse < 0.1, "{align}, {sigma} m: {rmse} deg");
            let position =
                json(&["evaluate", "ape", &reference, &estimate, "--align", align, "--json"]);
            assert!(position["rmse"].as_f64().unwrap() < 1.5 * sigma + 1e-5, "{position}");
        }
    }
}

#[test]
fn tables_of_inertial_data_in_every_spelling() {
    let folder = tempfile::tempdir().unwrap();
    let row = |i: u32| {
        let t = f64::from(i) * 0.005;
        [100.0 + t, 0.1 * t.sin(), 0.05, -0.02, 0.3, 0.1 * t.cos(), 9.8]
    };
    let table = |separator: &str| -> String {
        (0..800).map(|i| row(i).map(|x| format!("{x:.6}")).join(separator) + "\n").collect()
    };
    let names = "t,gx,gy,gz,ax,ay,az\n";
    let swapped: String = (0..800)
        .map(|i| {
            let [t, gx, gy, gz, ax, ay, az] = row(i);
            format!("{:.0},{ax:.6},{ay:.6},{az:.6},{gx:.6},{gy:.6},{gz:.6}\n", t * 1e9)
        })
        .collect();
    let last = |content: &str| -> Value {
        let path = write(folder.path(), "imu.csv", content);
        json(&["attitude", &path, "--json"])["last"].clone()
    };
    let expected = last(&format!("{names}{}", table(",")));
    assert!(expected["quaternion"].is_array(), "{expected}");
    for content in [
        table(","),
        format!("\u{feff}{}", format!("{names}{}", table(",")).replace('\n', "\r\n")),
        format!("{}{}", names.replace(',', ";"), table(";").replace('.', ",")),
        table("\t").replace('.', ","),
        format!(
            "#timestamp [ns],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2],\
             w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1]\n{swapped}"
        ),
    ] {
        assert_eq!(last(&content), expected, "{}", &content[..80]);
    }
    for (content, line) in [
        (format!("{names}{}1e9,0,0,0,0,0,9.8\n", table(",")), "line 802"),
        (format!("{names}0,0,0,0,0,0,9.8\n0.01,0,0,0,0,0\n"), "line 3"),
        (format!("{names}0,0,0,0,0,0,9.8\n14037155249071431680,0,0,0,0,0,9.8\n"), "line 3"),
    ] {
        let path = write(folder.path(), "bad.csv", content);
        let errors = fail(&["attitude", &path]);
        assert!(errors.contains("bad.csv") && errors.contains(line), "{errors}");
    }
}

#[test]
fn numbers_may_begin_with_their_point() {
    let folder = tempfile::tempdir().unwrap();
    let rows = rows(curve);
    let moved: Vec<[f64; 8]> = rows
        .iter()
        .map(|row| {
            let mut row = *row;
            row[0] += 0.5;
            row
        })
        .collect();
    let reference = write(folder.path(), "ref.txt", tum(&rows, " "));
    let estimate = write(folder.path(), "est.txt", tum(&moved, " "));
    for offset in ["-.5", "-0.5", "-5e-1"] {
        let answer =
            json(&["evaluate", "ape", &reference, &estimate, "--time-offset", offset, "--json"]);
        assert!(answer["rmse"].as_f64().unwrap() < 1e-6, "{offset}: {answer}");
    }
    let fisher = |last: &str| succeed(&["fisher", "7", "7", last, "--json"]);
    assert_eq!(fisher("-.5"), fisher("-0.5"));
    assert_eq!(mfg_vio(&["fisher", "7", "7", "-.x"]).status.code(), Some(2));
}

#[test]
fn a_table_from_a_pipe_is_read_as_from_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let reference = write(folder.path(), "ref.txt", tum(&rows(curve), " "));
    let program = env!("CARGO_BIN_EXE_mfg-vio");
    let output = Command::new(program)
        .args(["evaluate", "ape", "/dev/stdin", &reference, "--json"])
        .stdin(std::fs::File::open(&reference).unwrap())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
