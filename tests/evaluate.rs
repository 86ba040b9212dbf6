//! The contract of `mfg-vio evaluate`: exit status, what is on standard output, JSON keys.

use std::path::Path;
use std::process::{Command, Output};

use nalgebra::{UnitQuaternion, Vector3};
use serde_json::Value;

fn evaluate(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_mfg-vio"))
        .arg("evaluate")
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap()
}

#[track_caller]
fn json(folder: &Path, arguments: &[&str]) -> Value {
    let output = evaluate(folder, arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Standard error of a run that ends with `code` and prints nothing else.
#[track_caller]
fn failure(folder: &Path, arguments: &[&str], code: i32) -> String {
    let output = evaluate(folder, arguments);
    assert_eq!(output.status.code(), Some(code));
    assert!(output.stdout.is_empty());
    String::from_utf8(output.stderr).unwrap()
}

/// A folder with `ref.txt`, `est.txt` (0.1 m off in x at odd poses), the same in EuRoC's and
/// KITTI's formats, and a `state.csv`.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let names: Vec<String> = (0..36).map(|k| format!("cov_pose_{}{}", k / 6, k % 6)).collect();
    let [mut tum, mut estimate, mut euroc, mut kitti, mut state] =
        std::array::from_fn(|_| String::new());
    state += &format!("time,px,py,pz,qx,qy,qz,qw,{}\n", names.join(","));
    for i in 0..40 {
        let t = f64::from(i) * 0.1;
        let (x, y, z) = (2.0 * t.sin(), 2.0 * t.cos(), 0.3 * (2.0 * t).sin());
        let moved = x + if i % 2 == 1 { 0.1 } else { 0.0 };
        tum += &format!("{t} {x} {y} {z} 0 0 0 1\n");
        estimate += &format!("{t} {moved} {y} {z} 0 0 0 1\n");
        euroc += &format!("{},{moved},{y},{z},1,0,0,0,9,9,9\n", i64::from(i) * 100_000_000);
        kitti += &format!("1 0 0 {moved} 0 1 0 {y} 0 0 1 {z}\n");
        let diagonal = |k: usize| if k.is_multiple_of(7) { "0.01" } else { "0" };
        let covariance: Vec<&str> = (0..36).map(diagonal).collect();
        state += &format!("{t},{moved},{y},{z},0,0,0,1,{}\n", covariance.join(","));
    }
    let files = [
        ("ref.txt", tum),
        ("est.txt", estimate),
        ("est.csv", euroc),
        ("est_kitti.txt", kitti),
        ("state.csv", state),
    ];
    for (name, text) in files {
        std::fs::write(folder.path().join(name), text).unwrap();
    }
    folder
}

#[test]
fn ape_prints_the_promised_keys() {
    let folder = folder();
    let answer = json(folder.path(), &["ape", "ref.txt", "est.txt", "--align", "none", "--json"]);
    for key in [
        "matched",
        "reference_poses",
        "estimate_poses",
        "rmse",
        "mean",
        "median",
        "std",
        "min",
        "max",
        "sse",
        "alignment",
        "file",
    ] {
        assert!(answer.get(key).is_some(), "{key}");
    }
    assert_eq!(answer["matched"], 40);
    assert!((answer["rmse"].as_f64().unwrap() - 0.005_f64.sqrt()).abs() < 1e-12);
    assert_eq!(answer["alignment"]["rotation"][2], serde_json::json!([0.0, 0.0, 1.0]));
    assert_eq!(answer["alignment"]["scale"], 1.0);
}

#[test]
fn several_estimates_in_several_formats() {
    let folder = folder();
    let answer = json(folder.path(), &["ape", "ref.txt", "est.txt", "est.csv", "--json"]);
    let estimates = answer["estimates"].as_array().unwrap();
    assert_eq!(estimates.len(), 2);
    assert_eq!(estimates[1]["file"], "est.csv");
    let rmse = |k: usize| estimates[k]["rmse"].as_f64().unwrap();
    assert!((rmse(0) - rmse(1)).abs() < 1e-9);
    let text = failure(folder.path(), &["ape", "ref.txt", "est_kitti.txt"], 1);
    assert!(text.contains("est_kitti.txt") && text.contains("stamps"), "{text}");
    let kitti = json(folder.path(), &["ape", "est_kitti.txt", "est_kitti.txt", "--json"]);
    assert!(kitti["rmse"].as_f64().unwrap() < 1e-12);
}

#[test]
fn rpe_with_sub_trajectories() {
    let folder = folder();
    let arguments = ["rpe", "ref.txt", "est.txt", "--delta", "1", "--unit", "m", "--all-pairs"];
    let answer = json(folder.path(), &[&arguments[..], &["--lengths", "1,2", "--json"]].concat());
    assert_eq!(answer["sub_trajectories"].as_array().unwrap().len(), 2);
    assert!(answer["pairs"].as_u64().unwrap() > 10);
}

#[test]
fn nees_reads_a_run() {
    let folder = folder();
    let answer = json(folder.path(), &["nees", "ref.txt", ".", "--align", "none", "--json"]);
    assert!((answer["position"]["mean"].as_f64().unwrap() - 0.5).abs() < 1e-9);
    assert_eq!(answer["attitude"]["dof"], 3);
    assert_eq!(answer["joint"]["mean"], answer["position"]["mean"]);
}

#[test]
fn tables_plots_and_reports_are_written() {
    let folder = folder();
    let output = evaluate(folder.path(), &["ape", "ref.txt", "est.txt", "--csv"]);
    let csv = String::from_utf8(output.stdout).unwrap();
    assert!(csv.starts_with("file,matched,of,rmse") && csv.lines().count() == 2, "{csv}");
    assert!(String::from_utf8_lossy(&output.stderr).contains("matched 40 of 40"));
    for (plot, start) in [("a.svg", &b"<svg"[..]), ("a.png", &b"\x89PNG"[..])] {
        let output = evaluate(
            folder.path(),
            &["ape", "ref.txt", "est.txt", "--latex", "--plot", plot, "--report", "a.html"],
        );
        assert!(String::from_utf8_lossy(&output.stdout).starts_with("\\begin{tabular}"));
        let bytes = std::fs::read(folder.path().join(plot)).unwrap();
        assert!(bytes.starts_with(start), "{plot}");
    }
    let html = std::fs::read_to_string(folder.path().join("a.html")).unwrap();
    assert_eq!(html.matches("<svg").count(), 2);
}

#[test]
fn what_is_wrong_is_named() {
    let folder = folder();
    let path = folder.path();
    std::fs::write(path.join("bad.txt"), "0 0 0 0 0 0 0 1\n1 0 0 x 0 0 0 1\n").unwrap();
    let text = failure(path, &["ape", "ref.txt", "bad.txt"], 1);
    assert!(text.contains("bad.txt, line 2") && text.lines().count() == 1, "{text}");
    let text = failure(path, &["ape", "ref.txt", "absent.txt"], 1);
    assert!(text.contains("absent.txt") && text.lines().count() == 1, "{text}");
    let text = failure(path, &["ape", "ref.txt", "est.txt", "--time-offset", "-100"], 1);
    assert!(text.contains("0.000 to 3.900") && text.lines().count() == 1, "{text}");
    for usage in [
        &["ape", "ref.txt"][..],
        &["ape", "ref.txt", "est.txt", "--align", "best"],
        &["ape", "ref.txt", "est.txt", "--plot", "a.pdf"],
        &["rpe", "ref.txt", "est.txt", "--delta", "1.5"],
        &["nees", "ref.txt", ".", "--align", "sim3"],
    ] {
        failure(path, usage, 2);
    }
}

/// A body carried through a room: stamp (s), position (m), quaternion.
fn carried(t: f64) -> (f64, Vector3<f64>, UnitQuaternion<f64>) {
    let position =
        Vector3::new(2.0 * (0.7 * t).sin(), 1.5 * (0.9 * t).cos(), 0.4 * (1.3 * t).sin());
    let turn = Vector3::new(0.8 * t.sin(), 0.7 * (0.6 * t).cos(), 0.9 * (0.8 * t).sin());
    (t, position, UnitQuaternion::from_scaled_axis(turn))
}

/// Every classic mistake, made on purpose, is called by its name.
#[test]
fn every_guard_names_its_mistake() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let write = |name: &str, mistake: &dyn Fn(f64) -> (f64, Vector3<f64>, [f64; 4])| {
        let line = |i: u32| {
            let (t, p, [qx, qy, qz, qw]) = mistake(f64::from(i) * 0.05);
            format!("{t} {} {} {} {qx} {qy} {qz} {qw}\n", p.x, p.y, p.z)
        };
        std::fs::write(path.join(name), (0..600).map(line).collect::<String>()).unwrap();
    };
    let right = |t: f64| {
        let (t, p, q) = carried(t);
        (t, p, [q.i, q.j, q.k, q.w])
    };
    let warnings = |arguments: &[&str]| -> String {
        let answer = json(path, &[arguments, &["--json"]].concat());
        answer["warnings"].as_array().unwrap().iter().map(|w| w.as_str().unwrap()).collect()
    };
    write("ref.txt", &right);
    assert_eq!(warnings(&["ape", "ref.txt", "ref.txt", "--align", "yaw"]), "");

    write("sparse.txt", &|t| (if t < 1.0 { t } else { t + 0.02 }, right(t).1, right(t).2));
    assert!(warnings(&["ape", "ref.txt", "sparse.txt"]).contains("only 20 of 600 poses"));

    write("bridged.txt", &|t| (if t > 10.0 { t + 1.0 } else { t }, right(t).1, right(t).2));
    let found = warnings(&["ape", "ref.txt", "bridged.txt", "--max-diff", "0.3"]);
    assert!(found.contains("--max-diff bridges gaps"), "{found}");

    write("microseconds.txt", &|t| (1e6 * t, right(t).1, right(t).2));
    let text = failure(path, &["ape", "ref.txt", "microseconds.txt"], 1);
    assert!(text.contains("the estimate look like microseconds"), "{text}");
    write("nanoseconds.txt", &|t| ((1e9 * t).round(), right(t).1, right(t).2));
    assert_eq!(warnings(&["ape", "ref.txt", "nanoseconds.txt", "--align", "none"]), "");

    write("scalar_first.txt", &|t| {
        let (t, p, [x, y, z, w]) = right(t);
        (t, p, [w, x, y, z])
    });
    let found = warnings(&["ape", "ref.txt", "scalar_first.txt"]);
    assert!(found.contains("quaternions of the estimate look as if they were written w x y z"));
    let found = warnings(&["ape", "scalar_first.txt", "ref.txt"]);
    assert!(found.contains("quaternions of the reference look as if they were written w x y z"));

    write("inverse.txt", &|t| {
        let (t, p, [x, y, z, w]) = right(t);
        (t, p, [-x, -y, -z, w])
    });
    assert!(warnings(&["ape", "ref.txt", "inverse.txt"]).contains("inverse rotation"));

    let tilt = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 1.5);
    write("tilted.txt", &|t| {
        let (t, p, q) = carried(t);
        let q = tilt * q;
        (t, tilt * p, [q.i, q.j, q.k, q.w])
    });
    let found = warnings(&["ape", "ref.txt", "tilted.txt", "--align", "yaw"]);
    assert!(found.contains("tilted by 85.9 deg"), "{found}");
    assert_eq!(warnings(&["ape", "ref.txt", "tilted.txt", "--align", "se3"]), "");

    write("half.txt", &|t| (right(t).0, 0.5 * right(t).1, right(t).2));
    let found = warnings(&["ape", "ref.txt", "half.txt"]);
    assert!(found.contains("fits best when scaled by 2.000"), "{found}");

    write("late.txt", &|t| (right(t).0 + 0.15, right(t).1, right(t).2));
    let found = warnings(&["ape", "ref.txt", "late.txt"]);
    assert!(found.contains("--time-offset -0.150"), "{found}");
}

/// Of two estimates with one stamp OpenVINS compares the second with the next reference pose.
#[test]
fn the_association_of_openvins_can_be_chosen() {
    let folder = folder();
    let mut twice = std::fs::read_to_string(folder.path().join("ref.txt")).unwrap();
    let line = twice.lines().nth(20).unwrap().to_owned();
    // A line that says the same would be left out.
    let (stamp, pose) = line.split_once(' ').unwrap();
    let (x, rest) = pose.split_once(' ').unwrap();
    let other = format!("{stamp} {} {rest}", x.parse::<f64>().unwrap() + 1e-12);
    twice = twice.replacen(&line, &format!("{line}\n{other}"), 1);
    std::fs::write(folder.path().join("twice.txt"), twice).unwrap();
    let largest = |rule: &str| {
        let arguments = ["ape", "ref.txt", "twice.txt", "--association", rule, "--align", "none"];
        let arguments = [&arguments[..], &["--max-diff", "0.15", "--json"]].concat();
        json(folder.path(), &arguments)["max"].as_f64().unwrap()
    };
    assert!(largest("nearest") < 1e-11);
    assert!(largest("openvins") > 0.1);
    let text = failure(folder.path(), &["ape", "ref.txt", "est.txt", "--association", "best"], 2);
    assert!(text.contains("nearest, openvins"), "{text}");
}

#[test]
fn runs_are_compared() {
    let folder = folder();
    for (run, rmse) in [("a/1", 0.1), ("a/2", 0.2), ("b/1", 0.15), ("b/2", 0.27)] {
        let statistics = serde_json::json!({
            "rmse": rmse, "mean": rmse, "median": rmse, "std": 0.0, "min": rmse, "max": rmse, "sse": rmse,
        });
        let metrics = serde_json::json!({
            "path_length": 10.0,
            "evaluation": {
                "matched": 5, "ape_translation": statistics, "ape_rotation_deg": statistics,
            },
        });
        let directory = folder.path().join(run);
        std::fs::create_dir_all(&directory).unwrap();
        std::fs::write(directory.join("metrics.json"), metrics.to_string()).unwrap();
    }
    let answer = json(folder.path(), &["compare", "a", "b", "--json", "--plot", "c.svg"]);
    assert_eq!(answer["methods"][0]["success_rate"], 1.0);
    assert_eq!(answer["tests"][0]["runs"], 2);
    assert!(folder.path().join("c.svg").exists());
}
