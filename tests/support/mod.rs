//! What the integration tests share: the program, a small simulated log, the real recordings.

// Each test program uses a part of it.
#![allow(dead_code)]

pub mod messages;
pub mod ros2;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

/// The program with `arguments`, run to its end.
pub fn mfg_vio(arguments: &[&str]) -> Output {
    let program = env!("CARGO_BIN_EXE_mfg-vio");
    Command::new(program).args(arguments).output().expect("the program starts")
}

/// Its standard output, after checking that it succeeded.
pub fn succeed(arguments: &[&str]) -> String {
    let output = mfg_vio(arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {errors}");
    String::from_utf8(output.stdout).expect("output is UTF-8")
}

/// Its standard error, after checking that it failed at run time.
pub fn fail(arguments: &[&str]) -> String {
    let output = mfg_vio(arguments);
    assert_eq!(output.status.code(), Some(1), "{arguments:?}");
    assert!(output.stdout.is_empty(), "{arguments:?}");
    String::from_utf8(output.stderr).expect("messages are UTF-8")
}

/// The JSON object that is all of its standard output.
pub fn json(arguments: &[&str]) -> serde_json::Value {
    serde_json::from_str(&succeed(arguments)).expect("one JSON object")
}

/// Three seconds of the simulator's room, made once for a test program.
pub fn simulated_log() -> &'static Path {
    static LOG: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let (_, path) = LOG.get_or_init(|| {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("room.mcap");
        succeed(&["simulate", "--duration", "3", "--out", text(&path)]);
        (directory, path)
    });
    path
}

/// A recording of the development data; says loudly that the test is skipped where it is absent.
pub fn recording(name: &str) -> Option<PathBuf> {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let data = std::env::var_os("MFG_VIO_DATA").map_or(default, PathBuf::from);
    let path = data.join(name);
    if !path.exists() {
        eprintln!("SKIPPED: {} is absent (set MFG_VIO_DATA)", path.display());
        return None;
    }
    Some(path)
}

pub fn text(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

/// Lines of a text file.
pub fn lines(path: &Path) -> Vec<String> {
    let content = std::fs::read_to_string(path).expect("a readable file");
    content.lines().map(str::to_owned).collect()
}
