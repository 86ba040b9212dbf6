//! The structure that `ARCHITECTURE.md` promises, read from the sources: no module imports from a
//! layer below its own.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::PathBuf;

/// From the bottom of what may be used by all to what uses all.
const LAYERS: [&str; 22] = [
    "dialect",
    "output",
    "so3",
    "distribution",
    "sensor",
    "inertial",
    "alignment",
    "filter",
    "vision",
    "map",
    "tracking",
    "fault",
    "odometry",
    "dataset",
    "simulation",
    "evaluation",
    "experiment",
    "viewer",
    "config",
    "replay",
    "bench",
    "cli",
];

/// What the order of layers would allow, and is not meant.
const ALSO_FORBIDDEN: [(&str, &[&str]); 6] = [
    ("vision", &["filter"]),
    ("map", &["filter"]),
    ("dataset", &["filter", "map", "tracking", "fault", "odometry"]),
    ("simulation", &["filter", "map", "tracking", "fault", "odometry"]),
    ("evaluation", &["filter", "map", "tracking", "fault", "odometry", "simulation"]),
    ("viewer", &["filter", "map", "tracking", "dataset", "simulation", "experiment"]),
];

struct Source {
    path: PathBuf,
    /// Without its tests and comments.
    text: String,
}

impl Source {
    fn layer(&self) -> String {
        let below = self.path.strip_prefix("src").unwrap();
        let first = below.components().next().unwrap().as_os_str().to_str().unwrap();
        first.trim_end_matches(".rs").to_owned()
    }
}

fn sources() -> Vec<Source> {
    let mut folders = vec![PathBuf::from("src")];
    let mut sources = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            let is_test = path.file_stem().is_some_and(|stem| stem == "tests");
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") && !is_test {
                let text = product_code(&fs::read_to_string(&path).unwrap());
                sources.push(Source { path, text });
            }
        }
    }
    sources.sort_by(|a, b| a.path.cmp(&b.path));
    sources
}

/// The text of a file up to its test module, without comments.
fn product_code(text: &str) -> String {
    let end = text.find("\n#[cfg(test)]\nmod ").unwrap_or(text.len());
    let code = |line: &str| line.split("//").next().unwrap_or_default().to_owned();
    text[..end].lines().map(code).collect::<Vec<_>>().join("\n")
}

#[test]
fn a_layer_uses_only_those_above_it() {
    let place: BTreeMap<_, _> = LAYERS.iter().enumerate().map(|(i, layer)| (*layer, i)).collect();
    let mut wrong = BTreeSet::new();
    let mut seen = BTreeSet::new();
    for source in sources() {
        let layer = source.layer();
        if ["lib", "main"].contains(&layer.as_str()) {
            continue;
        }
        let own = *place.get(layer.as_str()).unwrap_or_else(|| {
            panic!("{}: layer `{layer}` has no place in LAYERS", source.path.display())
        });
        seen.insert(layer.clone());
        let forbidden: Vec<_> = ALSO_FORBIDDEN
            .iter()
            .filter(|(of, _)| *of == layer)
            .flat_map(|(_, forbidden)| forbidden.iter().copied())
            .collect();
        for used in named_layers(&source.text) {
            let Some(other) = place.get(used.as_str()) else { continue };
            if *other > own || forbidden.contains(&used.as_str()) {
                wrong.insert(format!("{} uses `{used}`", source.path.display()));
            }
        }
    }
    assert!(seen.len() > 12, "too few layers found: {seen:?}");
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// Every `crate::x` and `mfg_vio::x` in the code.
fn named_layers(text: &str) -> BTreeSet<String> {
    let mut layers = BTreeSet::new();
    for root in ["crate::", "mfg_vio::"] {
        for (at, _) in text.match_indices(root) {
            let name: String = text[at + root.len()..]
                .chars()
                .take_while(|c| c.is_alphanumeric() || *c == '_')
                .collect();
            layers.insert(name);
        }
    }
    layers
}
