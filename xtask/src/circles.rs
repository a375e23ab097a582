//! Circles of imports: modules beside each other of which none can be understood without the others.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// A module by its path in the crate; the root is empty.
type Module = Vec<String>;

/// The circles of a crate, each as the folder it is in (`crate` is the root) and the modules of it.
pub(crate) fn of(src: &Path) -> Vec<(String, Vec<String>)> {
    let mut files = Vec::new();
    collect(src, &mut files);
    let named = |file: &PathBuf| (module(file.strip_prefix(src).unwrap_or(file)), file.clone());
    let files: BTreeMap<Module, PathBuf> = files.iter().map(named).collect();
    let texts = files.iter().map(|(module, file)| (module.clone(), fs::read_to_string(file).unwrap_or_default()));
    among(&texts.collect())
}

fn collect(dir: &Path, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(dir).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() {
            collect(&path, files);
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path);
        }
    }
}

/// The module of a file of `src`.
fn module(file: &Path) -> Module {
    let mut module: Module = file.with_extension("").iter().map(|part| part.to_string_lossy().into_owned()).collect();
    module.pop_if(|last| ["mod", "lib", "main"].contains(&last.as_str()));
    module
}

fn among(texts: &BTreeMap<Module, String>) -> Vec<(String, Vec<String>)> {
    // For each folder, who of its modules imports from which others of them, by itself or by a module inside it.
    let mut folders: BTreeMap<&[String], BTreeMap<&str, BTreeSet<&str>>> = BTreeMap::new();
    let imported: Vec<(&Module, Module)> = texts
        .iter()
        .flat_map(|(at, text)| imports(at, text, texts).into_iter().map(move |other| (at, other)))
        .collect();
    for (at, other) in &imported {
        let common = at.iter().zip(other).take_while(|(a, b)| a == b).count();
        if common < at.len() && common < other.len() {
            folders.entry(&at[..common]).or_default().entry(&at[common]).or_default().insert(&other[common]);
        }
    }
    let mut circles = Vec::new();
    for (folder, edges) in folders {
        let circle: Vec<String> =
            edges.keys().filter(|m| reached(&edges, m).contains(*m)).map(|m| (*m).to_owned()).collect();
        if !circle.is_empty() {
            circles.push((if folder.is_empty() { "crate".into() } else { folder.join("::") }, circle));
        }
    }
    circles
}

/// What can be reached from a module by imports.
fn reached<'a>(edges: &BTreeMap<&'a str, BTreeSet<&'a str>>, from: &'a str) -> BTreeSet<&'a str> {
    let (mut seen, mut next) = (BTreeSet::new(), vec![from]);
    while let Some(module) = next.pop() {
        next.extend(edges.get(module).into_iter().flatten().filter(|m| seen.insert(**m)));
    }
    seen
}

/// The modules that a module names by `crate::` or `super::`, tests and comments left out.
fn imports(at: &Module, text: &str, modules: &BTreeMap<Module, String>) -> BTreeSet<Module> {
    let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
    let code: String = code.lines().flat_map(|line| [line.split("//").next().unwrap_or_default(), "\n"]).collect();
    let mut paths = Vec::new();
    for start in ["crate::", "super::"] {
        for (i, _) in code.match_indices(start) {
            let inside = code[..i].chars().next_back().is_some_and(|c| c.is_alphanumeric() || "_:".contains(c));
            if !inside {
                tree(&code[i..], &mut Vec::new(), &mut paths);
            }
        }
    }
    paths.iter().map(|path| resolve(at, path, modules)).collect()
}

/// Reads a path, or several with a common beginning in braces; what follows it.
fn tree<'t>(text: &'t str, before: &mut Vec<&'t str>, paths: &mut Vec<Vec<&'t str>>) -> &'t str {
    let text = text.trim_start();
    if let Some(mut rest) = text.strip_prefix('{') {
        loop {
            // What is left of a path is another name for it.
            rest = tree(rest, before, paths).trim_start_matches(|c| c != ',' && c != '}');
            match rest.strip_prefix(',') {
                Some(more) => rest = more,
                None => return rest.strip_prefix('}').unwrap_or(rest),
            }
        }
    }
    let end = text.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(text.len());
    let (name, rest) = text.split_at(end);
    before.push(name);
    let rest = match rest.strip_prefix("::") {
        Some(rest) => tree(rest, before, paths),
        None => {
            paths.push(before.clone());
            rest.strip_prefix('*').unwrap_or(rest)
        }
    };
    before.pop();
    rest
}

/// The module that a path leads into.
fn resolve(at: &Module, path: &[&str], modules: &BTreeMap<Module, String>) -> Module {
    let up = path.iter().take_while(|part| **part == "super").count();
    let mut module = if up == 0 { Module::new() } else { at[..at.len().saturating_sub(up)].to_vec() };
    for part in &path[up.max(1)..] {
        module.push((*part).to_owned());
        if !modules.contains_key(&module) {
            module.pop();
            break;
        }
    }
    module
}

#[cfg(test)]
mod tests {
    use super::*;

    fn circles(files: &[(&str, &str)]) -> Vec<(String, Vec<String>)> {
        among(&files.iter().map(|(file, text)| (module(file.as_ref()), (*text).to_owned())).collect())
    }

    #[test]
    fn a_circle_is_found_through_braces_and_modules_inside() {
        let files = [
            ("lib.rs", "mod a; mod b; mod c;"),
            ("a/mod.rs", "mod inner;"),
            ("a/inner.rs", "use crate::{c::Thing as C, b::{\n    Other,\n    more::*,\n}};"),
            ("b.rs", "fn f() -> usize { super::c::number() }"),
            ("c.rs", "use super::a::Back;"),
        ];
        assert_eq!(circles(&files), [("crate".to_owned(), vec!["a".to_owned(), "b".into(), "c".into()])]);
    }

    #[test]
    fn parents_tests_and_comments_make_no_circle() {
        let files = [
            ("lib.rs", "mod a; mod b;"),
            ("a/mod.rs", "mod x; mod y; use x::X;"),
            ("a/x.rs", "use super::Shared; use super::y::Y; // use crate::b::B;"),
            ("a/y.rs", "use super::Shared;\n\n#[cfg(test)]\nmod tests {\n    use super::super::x::X;\n}"),
            ("b.rs", "use crate::a::Shared;"),
        ];
        assert!(circles(&files).is_empty(), "{:?}", circles(&files));
    }
}
