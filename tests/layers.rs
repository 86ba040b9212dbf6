//! The structure that `ARCHITECTURE.md` promises, read from the sources: no module imports from a
//! layer below its own, and no two files of a module import each other.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

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

    /// Module path below the crate: `["filter", "visual", "slam"]`.
    fn module(&self) -> Vec<String> {
        let below = self.path.strip_prefix("src").unwrap().with_extension("");
        let mut parts: Vec<_> =
            below.iter().map(|part| part.to_str().unwrap().to_owned()).collect();
        parts.retain(|part| part != "mod" && part != "lib");
        parts
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

/// The paths that a `use` tree names: `a::{b, c::d}` is `a::b` and `a::c::d`.
fn expand(tree: &str) -> Vec<Vec<String>> {
    let tree = tree.trim();
    let Some(open) = tree.find('{') else {
        let path = tree.split(" as ").next().unwrap_or_default();
        return vec![path.split("::").map(|part| part.trim().to_owned()).collect()];
    };
    let prefix: Vec<_> = tree[..open]
        .split("::")
        .map(|part| part.trim().to_owned())
        .filter(|part| !part.is_empty())
        .collect();
    let close = tree.rfind('}').unwrap_or(tree.len());
    let mut depth = 0;
    let mut items = vec![String::new()];
    for character in tree[open + 1..close].chars() {
        match character {
            ',' if depth == 0 => items.push(String::new()),
            _ => {
                depth += i32::from(character == '{') - i32::from(character == '}');
                items.last_mut().unwrap().push(character);
            }
        }
    }
    items
        .iter()
        .filter(|item| !item.trim().is_empty())
        .flat_map(|item| expand(item))
        .map(|path| prefix.iter().cloned().chain(path).collect())
        .collect()
}

/// The paths of the crate that a file imports, and those it passes on (`pub use`).
fn imports(source: &Source) -> (Vec<Vec<String>>, Vec<Vec<String>>) {
    let (mut used, mut passed_on) = (Vec::new(), Vec::new());
    let mut lines = source.text.lines();
    while let Some(line) = lines.next() {
        let line = line.trim_start();
        let Some(at) = line.find("use ").filter(|at| *at == 0 || line.starts_with("pub")) else {
            continue;
        };
        let mut statement = line[at + 4..].to_owned();
        while !statement.contains(';') {
            let Some(more) = lines.next() else { break };
            statement.push_str(more);
        }
        let tree = statement.split(';').next().unwrap_or_default();
        let paths = expand(tree).into_iter().filter_map(|path| absolute(source, &path));
        if at == 0 { used.extend(paths) } else { passed_on.extend(paths) }
    }
    (used, passed_on)
}

/// A path from the crate's root, if it is one within the crate.
fn absolute(source: &Source, path: &[String]) -> Option<Vec<String>> {
    let is_module_root = source.path.ends_with("mod.rs") || source.path.ends_with("lib.rs");
    let mut module = source.module();
    let mut rest = path;
    match path.first()?.as_str() {
        "crate" | "mfg_vio" => return Some(path[1..].to_vec()),
        "super" | "self" => {
            while let Some(first) = rest.first() {
                match first.as_str() {
                    "super" => drop(module.pop()),
                    "self" => {}
                    _ => break,
                }
                rest = &rest[1..];
            }
        }
        first if is_module_root && has_file(&module, first) => {}
        _ => return None,
    }
    module.extend_from_slice(rest);
    Some(module)
}

fn has_file(module: &[String], name: &str) -> bool {
    let folder = module.iter().fold(PathBuf::from("src"), |path, part| path.join(part));
    folder.join(format!("{name}.rs")).exists() || folder.join(name).join("mod.rs").exists()
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

/// The file that holds what a path of the crate names.
fn file_of(path: &[String], passed_on: &BTreeMap<Vec<String>, Vec<String>>) -> Option<PathBuf> {
    let mut path = path.to_vec();
    for _ in 0..8 {
        match passed_on.get(&path) {
            Some(origin) if *origin != path => path = origin.clone(),
            _ => break,
        }
    }
    (1..=path.len()).rev().find_map(|length| {
        let base = path[..length].iter().fold(PathBuf::from("src"), |p, part| p.join(part));
        [base.with_extension("rs"), base.join("mod.rs")].into_iter().find(|file| file.exists())
    })
}

#[test]
fn files_do_not_import_each_other_in_circles() {
    let sources = sources();
    let mut passed_on = BTreeMap::new();
    let mut uses = Vec::new();
    for source in &sources {
        let (used, passed) = imports(source);
        for path in passed {
            let mut name = source.module();
            name.extend(path.last().cloned());
            passed_on.insert(name, path);
        }
        uses.push((source.path.clone(), used));
    }
    let mut edges: BTreeMap<PathBuf, BTreeSet<PathBuf>> = BTreeMap::new();
    for (file, used) in uses {
        let targets = used.iter().filter_map(|path| file_of(path, &passed_on));
        let others: BTreeSet<_> = targets.filter(|target| *target != file).collect();
        edges.insert(file, others);
    }
    assert!(edges.values().map(BTreeSet::len).sum::<usize>() > 200, "too few imports found");
    let circles = circles(&edges);
    let folders: BTreeSet<_> = circles.iter().filter_map(|files| common_folder(files)).collect();
    let known: BTreeSet<_> = STILL_CIRCLES.iter().map(PathBuf::from).collect();
    let new: Vec<_> = folders.difference(&known).collect();
    assert!(new.is_empty(), "circles in {new:?}: {circles:#?}");
    let gone: Vec<_> = known.difference(&folders).collect();
    assert!(gone.is_empty(), "no circle any more, to be taken from the list: {gone:?}");
}

/// Folders in which files still import each other in circles: the list may only get shorter.
const STILL_CIRCLES: [&str; 7] = [
    "src/bench",
    "src/config/import",
    "src/dataset",
    "src/evaluation/plot",
    "src/inertial/directions",
    "src/simulation",
    "src/simulation/world",
];

fn common_folder(files: &[PathBuf]) -> Option<PathBuf> {
    let first = files.first()?.parent()?;
    let shared = |folder: &&Path| files.iter().all(|file| file.starts_with(folder));
    first.ancestors().find(shared).map(Path::to_path_buf)
}

/// Groups of files that reach each other.
fn circles(edges: &BTreeMap<PathBuf, BTreeSet<PathBuf>>) -> Vec<Vec<PathBuf>> {
    let reach: BTreeMap<&Path, BTreeSet<&Path>> =
        edges.keys().map(|file| (file.as_path(), reachable(file, edges))).collect();
    let mut found = BTreeSet::new();
    for (file, reached) in &reach {
        let group: Vec<_> = reached
            .iter()
            .filter(|other| reach.get(*other).is_some_and(|back| back.contains(file)))
            .map(|path| path.to_path_buf())
            .collect();
        if !group.is_empty() {
            found.insert(group);
        }
    }
    found.into_iter().collect()
}

fn reachable<'a>(
    from: &'a Path,
    edges: &'a BTreeMap<PathBuf, BTreeSet<PathBuf>>,
) -> BTreeSet<&'a Path> {
    let mut reached = BTreeSet::new();
    let mut waiting = vec![from];
    while let Some(file) = waiting.pop() {
        for next in edges.get(file).into_iter().flatten() {
            if reached.insert(next.as_path()) {
                waiting.push(next);
            }
        }
    }
    reached
}
