//! Owns the text of an experiment: its file, those that it extends and the `--set` arguments as one tree that remembers where
//! each value came from.
//!
//! All texts are joined into one string and every span points into it, so that a value, wherever it came from, can be
//! reported with its file and line or with its argument.

use std::fmt;
use std::fs::File;
use std::io::{self, Read};
use std::ops::Range;
use std::path::{Path, PathBuf};

use toml::Spanned;
use toml::de::{DeArray, DeString, DeTable, DeValue};

use crate::shipped;

/// Where a value was given.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// A line of the file, counted from 1.
    Line(PathBuf, usize),
    /// The file as a whole.
    File(PathBuf),
    /// A `--set` argument.
    Set(String),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(path, line) => write!(f, "{}:{line}", path.display()),
            Self::File(path) => write!(f, "{}", path.display()),
            Self::Set(argument) => write!(f, "--set {argument}"),
        }
    }
}

/// What is wrong with an experiment: where, and the rule with the offending key, value and legal range.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{place}: {problem}")]
pub struct ConfigError {
    /// Where.
    pub place: Place,
    /// What.
    pub problem: String,
}

/// How the text of a file is come by, or why it cannot be.
pub type ReadText<'r> = &'r dyn Fn(&Path) -> Result<String, String>;

/// The joined text of an experiment's file, of those it extends, nearest first, and of all `--set` arguments.
#[derive(Clone, Debug)]
pub struct Source {
    text: String,
    files: Vec<(PathBuf, Range<usize>)>,
    arguments: Vec<Range<usize>>,
}

/// The most that a file may hold.
const MOST_BYTES: u64 = 1 << 20;

/// The text of a file of experiments, or of one that was [`shipped`]; `what` it is, for the message.
///
/// # Errors
/// A file that cannot be read, is no text, or is longer than any such file.
pub fn read_text(path: &Path, what: &str) -> Result<String, String> {
    if shipped::is_shipped(path) {
        let missing = || format!("there is no such {what}: {}", shipped::names().collect::<Vec<_>>().join(", "));
        return shipped::text(path).map(str::to_owned).ok_or_else(missing);
    }
    let read = || {
        let mut bytes = Vec::new();
        File::open(path)?.take(MOST_BYTES + 1).read_to_end(&mut bytes)?;
        Ok(bytes)
    };
    let bytes = read().map_err(|e: io::Error| {
        let known = if e.kind() == io::ErrorKind::NotFound { shipped::like(path) } else { String::new() };
        format!("cannot read the {what} file: {e}{known}")
    })?;
    if bytes.len() as u64 > MOST_BYTES {
        return Err(format!("larger than {MOST_BYTES} bytes, no {what} file"));
    }
    String::from_utf8(bytes)
        .map_err(|_| format!("not a text file; a scene is named by --set data.path=FILE, after the {what}"))
}

impl Source {
    /// Reads a file, what it extends, and the `--set` arguments; `what` the file is, for messages.
    ///
    /// # Errors
    /// As [`read_text`] and [`Source::new`].
    pub fn read(path: &Path, what: &str, arguments: &[String]) -> Result<Self, ConfigError> {
        let text =
            read_text(path, what).map_err(|problem| ConfigError { place: Place::File(path.to_owned()), problem })?;
        Self::new(path, &text, arguments, &|path| read_text(path, what))
    }

    /// Joins a file's text, those of the files it extends, which `read` knows, and the `--set` arguments.
    ///
    /// # Errors
    /// A file that extends one that cannot be read, or in the end itself.
    pub fn new(path: &Path, text: &str, arguments: &[String], read: ReadText<'_>) -> Result<Self, ConfigError> {
        let mut source = Self { text: String::new(), files: Vec::new(), arguments: Vec::new() };
        let range = source.append(text);
        source.files.push((path.to_owned(), range));
        while let Some((path, text)) = source.base(read)? {
            let range = source.append(&text);
            source.files.push((path, range));
        }
        for argument in arguments {
            let range = source.append(argument);
            source.arguments.push(range);
        }
        Ok(source)
    }

    /// Line breaks keep the texts apart, so that the end of one is not the beginning of the next.
    fn append(&mut self, text: &str) -> Range<usize> {
        let start = self.text.len();
        self.text.push_str(text);
        let end = self.text.len();
        self.text.push('\n');
        start..end
    }

    /// Path and text of what the last file extends.
    fn base(&self, read: ReadText<'_>) -> Result<Option<(PathBuf, String)>, ConfigError> {
        let (file, range) = self.last_file();
        // What is no TOML is reported when all of it is parsed.
        let Ok(table) = DeTable::parse(&self.text[range.clone()]) else { return Ok(None) };
        let Some(value) = table.get_ref().get(EXTENDS) else { return Ok(None) };
        let span = value.span().start + range.start..value.span().end + range.start;
        let Some(name) = value.get_ref().as_str().filter(|name| !name.is_empty()) else {
            let legal = "the path of another such file, in quotes";
            return Err(self.not_legal(&span, EXTENDS, legal));
        };
        let refuse = |problem: String| Err(self.error(&span, format!("`{EXTENDS}` = {name:?}: {problem}")));
        let named = Path::new(name);
        let path = if shipped::is_shipped(named) { named.to_owned() } else { folder_of(file).join(name) };
        if self.files.iter().any(|(known, _)| identity(known) == identity(&path)) {
            let names = self.files.iter().map(|(path, _)| path).chain([&path]);
            let chain: Vec<String> = names.map(|path| path.display().to_string()).collect();
            return refuse(format!("a file cannot extend itself: {}", chain.join(" → ")));
        }
        match read(&path) {
            Ok(text) => Ok(Some((path, text))),
            Err(problem) => refuse(format!("{}: {problem}", path.display())),
        }
    }

    fn last_file(&self) -> &(PathBuf, Range<usize>) {
        self.files.last().expect("a source begins with a file")
    }

    /// The file's path.
    pub fn path(&self) -> &Path {
        &self.files[0].0
    }

    /// The file and those that it extends, nearest first, with their texts.
    pub fn files(&self) -> impl Iterator<Item = (&Path, &str)> {
        self.files.iter().map(|(path, range)| (path.as_path(), &self.text[range.clone()]))
    }

    /// The folder that a path given at a span is relative to: that of its file, or the current one for a `--set` argument.
    pub fn folder(&self, span: &Range<usize>) -> PathBuf {
        match self.place(span) {
            Place::Set(_) => PathBuf::from("."),
            Place::Line(path, _) | Place::File(path) => folder_of(&path),
        }
    }

    /// The place of a span.
    pub fn place(&self, span: &Range<usize>) -> Place {
        let holds = |range: &Range<usize>| range.start <= span.start && span.start <= range.end;
        if let Some(argument) = self.arguments.iter().find(|range| holds(range)) {
            return Place::Set(self.text[argument.clone()].to_owned());
        }
        let (path, range) = self.files.iter().find(|(_, range)| holds(range)).unwrap_or(&self.files[0]);
        let before = &self.text.as_bytes()[range.start..span.start.clamp(range.start, range.end)];
        Place::Line(path.clone(), 1 + before.iter().filter(|&&b| b == b'\n').count())
    }

    /// The text of a value, shortened to one readable line.
    pub fn snippet(&self, span: &Range<usize>) -> String {
        let text = self.text.get(span.clone()).unwrap_or_default();
        let line = text.lines().next().unwrap_or_default();
        let short: String = line.chars().take(60).collect();
        if short.len() < text.len() { format!("{short}…") } else { short }
    }

    /// An error at a span.
    pub fn error(&self, span: &Range<usize>, problem: impl Into<String>) -> ConfigError {
        ConfigError { place: self.place(span), problem: problem.into() }
    }

    /// An error about the value of a key.
    pub fn not_legal(&self, span: &Range<usize>, key: &str, legal: &str) -> ConfigError {
        self.error(span, format!("`{key}` = {} is not legal; legal: {legal}", self.snippet(span)))
    }

    /// An error about the file as a whole.
    pub fn file_error(&self, problem: impl Into<String>) -> ConfigError {
        ConfigError { place: Place::File(self.path().to_owned()), problem: problem.into() }
    }

    /// The place of a dotted key, or of the last table on the way to it that is there.
    pub fn span(&self, key: &str) -> Option<Range<usize>> {
        self.tree().ok().and_then(|tree| span_of(&tree, key))
    }

    /// An error about a value, or a table, that is not what serde expects there.
    pub fn mismatch(&self, span: &Range<usize>, expectation: &str) -> ConfigError {
        let key = self.tree().ok().and_then(|tree| key_at(&tree, span)).unwrap_or_default();
        let missing = expectation.strip_prefix("missing field `").and_then(|rest| rest.strip_suffix('`'));
        let problem = match (missing, key.as_str()) {
            (Some(field), "") => format!("`{field}` is missing"),
            (Some(field), table) => format!("`{table}.{field}` is missing"),
            (None, "") => expectation.to_owned(),
            (None, key) => format!("`{key}` = {} is not legal: {expectation}", self.snippet(span)),
        };
        self.error(span, problem)
    }

    /// An error at a dotted key, or at the last table on the way to it that is there.
    pub fn error_at(&self, key: &str, problem: impl Into<String>) -> ConfigError {
        match self.span(key) {
            Some(span) => self.error(&span, problem),
            None => self.file_error(problem),
        }
    }

    /// Parses the files, the later ones over what they extend, and applies the arguments in order.
    ///
    /// # Errors
    /// TOML that does not parse, an argument without `=`, or a key path that leads nowhere.
    pub fn tree(&self) -> Result<DeTable<'_>, ConfigError> {
        let mut root = DeTable::new();
        for (_, range) in self.files.iter().rev() {
            lay_over(&mut root, self.parse(range)?);
        }
        for range in &self.arguments {
            self.apply(&mut root, range)?;
        }
        Ok(root)
    }

    fn parse(&self, range: &Range<usize>) -> Result<DeTable<'_>, ConfigError> {
        let table = DeTable::parse(&self.text[range.clone()]).map_err(|e| {
            let at = range.start + e.span().unwrap_or(0..0).start;
            self.error(&(at..at), format!("not valid TOML: {}", e.message().replace('\n', ", ")))
        })?;
        let mut table = shift_table(table.into_inner(), range.start);
        table.remove(EXTENDS);
        Ok(table)
    }

    fn apply<'s>(&'s self, root: &mut DeTable<'s>, range: &Range<usize>) -> Result<(), ConfigError> {
        let argument = &self.text[range.clone()];
        let Some((key, value)) = argument.split_once('=') else {
            return Err(self.error(range, "expected key=value, for example --set stage.0.sigma=25"));
        };
        let value_at = range.start + key.len() + 1;
        // What is not TOML is meant as text: `--set solver.start=mean` needs no quotes in a shell.
        let value = match DeValue::parse(value) {
            Ok(parsed) => shift(parsed, value_at),
            Err(_) => Spanned::new(value_at..range.end, DeValue::String(value.trim().into())),
        };
        let steps: Vec<&str> = key.trim().split('.').map(str::trim).collect();
        if steps.iter().any(|s| s.is_empty()) {
            return Err(self.error(range, format!("{key:?} is not a dotted key such as solver.start or stage.0.sigma")));
        }
        if steps == [EXTENDS] {
            return Err(self.error(range, format!("`{EXTENDS}` is a line of a file: name another file instead")));
        }
        let (last, parents) = steps.split_last().expect("split always yields one step");
        let mut table = root;
        let mut parents = parents.iter();
        while let Some(step) = parents.next() {
            let slot = table
                .entry(Spanned::new(range.clone(), (*step).into()))
                .or_insert_with(|| Spanned::new(range.clone(), DeValue::Table(DeTable::new())))
                .get_mut();
            table = match slot {
                DeValue::Table(inner) => inner,
                DeValue::Array(list) => {
                    let index = parents.next();
                    self.element(list, step, index.copied(), range)?
                }
                _ => return Err(self.error(range, format!("`{step}` is a single value, it has no key below it"))),
            };
        }
        table.insert(Spanned::new(range.clone(), (*last).into()), value);
        Ok(())
    }

    fn element<'a, 's>(
        &self,
        list: &'a mut DeArray<'s>,
        name: &str,
        index: Option<&str>,
        range: &Range<usize>,
    ) -> Result<&'a mut DeTable<'s>, ConfigError> {
        let count = list.len();
        let parsed = index.and_then(|i| i.parse::<usize>().ok()).filter(|&i| i < count);
        let element = parsed.and_then(|i| list.get_mut(i)).map(Spanned::get_mut);
        match element {
            Some(DeValue::Table(table)) => Ok(table),
            _ => {
                let index = index.unwrap_or("nothing");
                let last = count.saturating_sub(1);
                Err(self.error(
                    range,
                    format!("`{name}` is a list of {count}: write {name}.0 to {name}.{last}, not {name}.{index}"),
                ))
            }
        }
    }
}

/// The key that names the file which another one differs from.
const EXTENDS: &str = "extends";

fn folder_of(file: &Path) -> PathBuf {
    file.parent().filter(|p| !p.as_os_str().is_empty()).map_or_else(|| PathBuf::from("."), Path::to_owned)
}

/// The same for all ways to name a file.
fn identity(path: &Path) -> PathBuf {
    path.canonicalize().or_else(|_| std::path::absolute(path)).unwrap_or_else(|_| path.to_owned())
}

/// Lays a file over the one that it extends: tables key by key, all else as a whole. A table of another `kind` is another table.
fn lay_over<'s>(base: &mut DeTable<'s>, over: DeTable<'s>) {
    for (key, value) in over {
        let below = base.get_mut(key.get_ref().as_ref()).map(Spanned::get_mut);
        match (below, value) {
            (Some(DeValue::Table(below)), value) if value.get_ref().as_table().is_some_and(|t| same_kind(below, t)) => {
                if let DeValue::Table(table) = value.into_inner() {
                    lay_over(below, table);
                }
            }
            (_, value) => {
                // A map keeps the key that it has, with its place.
                base.remove(key.get_ref().as_ref());
                base.insert(key, value);
            }
        }
    }
}

fn same_kind(below: &DeTable<'_>, over: &DeTable<'_>) -> bool {
    let kind = |table: &DeTable<'_>| table.get("kind").and_then(|k| k.get_ref().as_str().map(str::to_owned));
    kind(over).is_none_or(|over| kind(below) == Some(over))
}

fn span_of(tree: &DeTable<'_>, key: &str) -> Option<Range<usize>> {
    let mut steps = key.split('.');
    let mut found = tree.get(steps.next()?)?;
    for step in steps {
        let next = match step.parse::<usize>() {
            Ok(index) => found.get_ref().get(index),
            Err(_) => found.get_ref().get(step),
        };
        let Some(next) = next else { break };
        found = next;
    }
    Some(found.span())
}

/// The dotted key of what lies at a span.
fn key_at(table: &DeTable<'_>, span: &Range<usize>) -> Option<String> {
    let below = |(key, value): (String, &Spanned<DeValue<'_>>)| {
        if value.span() == *span {
            return Some(key);
        }
        let deeper = match value.get_ref() {
            DeValue::Table(table) => key_at(table, span),
            DeValue::Array(list) => list.iter().position(|item| item.span() == *span).map(|index| index.to_string()),
            _ => None,
        };
        Some(format!("{key}.{}", deeper?))
    };
    table.iter().map(|(key, value)| (key.get_ref().to_string(), value)).find_map(below)
}

/// Moves every span of a value parsed from a part of the text.
fn shift(value: Spanned<DeValue<'_>>, by: usize) -> Spanned<DeValue<'_>> {
    let span = value.span();
    let inner = match value.into_inner() {
        DeValue::Array(list) => DeValue::Array(list.into_iter().map(|v| shift(v, by)).collect()),
        DeValue::Table(table) => DeValue::Table(shift_table(table, by)),
        other => other,
    };
    Spanned::new(span.start + by..span.end + by, inner)
}

fn shift_table(table: DeTable<'_>, by: usize) -> DeTable<'_> {
    let key = |key: Spanned<DeString<'_>>| key.span().start + by..key.span().end + by;
    table.into_iter().map(|(k, v)| (Spanned::new(key(k.clone()), k.into_inner()), shift(v, by))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(file: &str, arguments: &[&str]) -> Source {
        extending(file, arguments, &[]).unwrap()
    }

    /// `a.toml` with this text, beside the files of these names and texts.
    fn extending(file: &str, arguments: &[&str], others: &[(&str, &str)]) -> Result<Source, ConfigError> {
        let arguments: Vec<String> = arguments.iter().map(|s| (*s).to_owned()).collect();
        let read = |path: &Path| match others.iter().find(|(name, _)| Path::new(name) == path) {
            Some((_, text)) => Ok((*text).to_owned()),
            None => Err("no such file".to_owned()),
        };
        Source::new(Path::new("./a.toml"), file, &arguments, &read)
    }

    #[test]
    fn a_file_lies_over_what_it_extends() {
        let top = "extends = \"b.toml\"\nx = 2\n[solver]\ngamma = 1\n[denoiser]\nkind = \"tv\"\n[[stage]]\nsigma = 1\n";
        let below =
            "extends = \"sub/c.toml\"\nx = 1\ny = 1\n\n[denoiser]\nkind = \"wnnm\"\npatch = 3\n[[stage]]\n[[stage]]\n";
        let last = "z = 5\n[solver]\nkind = \"admm\"\ngamma = 2\n";
        let s = extending(top, &["solver.rho=3"], &[("./b.toml", below), ("./sub/c.toml", last)]).unwrap();
        let tree = s.tree().unwrap();
        let text = |key: &str| s.snippet(&span_of(&tree, key).unwrap());
        assert_eq!(["x", "y", "z", "solver.kind", "solver.gamma"].map(text), ["2", "1", "5", "\"admm\"", "1"]);
        assert_eq!(text("solver.rho"), "3");
        assert_eq!(tree["stage"].get_ref().as_array().unwrap().len(), 1);
        // Nothing is left of a denoiser of another kind.
        assert_eq!(tree["denoiser"].get_ref().as_table().unwrap().len(), 1);
        assert_eq!(s.place(&span_of(&tree, "y").unwrap()), Place::Line("./b.toml".into(), 3));
        assert_eq!(s.folder(&span_of(&tree, "z").unwrap()), Path::new("./sub"));
        assert!(tree.get("extends").is_none());
    }

    #[test]
    fn what_cannot_be_extended_is_named() {
        let circle = [("./b.toml", "extends = \"a.toml\""), ("./bad.toml", "x = 1\ny = ")];
        for (text, needles) in [
            ("\nextends = \"b.toml\"", ["./b.toml:1: ", "`extends` = \"a.toml\"", "./a.toml → ./b.toml → ./a.toml"]),
            ("\nextends = \"no.toml\"", ["./a.toml:2: ", "`extends` = \"no.toml\"", "./no.toml: no such file"]),
            ("extends = 3", ["./a.toml:1: ", "`extends` = 3 is not legal", "the path"]),
            ("extends = \"bad.toml\"", ["./bad.toml:2: ", "not valid TOML", ""]),
        ] {
            let tried = extending(text, &[], &circle);
            let error = tried.and_then(|s| s.tree().map(|_| ())).unwrap_err().to_string();
            assert!(needles.iter().all(|needle| error.contains(needle)), "{error}");
        }
        let set = source("x = 1", &["extends=b.toml"]).tree().unwrap_err().to_string();
        assert!(set.contains("--set extends=b.toml") && set.contains("line of a file"), "{set}");
    }

    #[test]
    fn arguments_override_and_remember_themselves() {
        let s = source("x = 1\n[[stage]]\nsigma = 50\n", &["stage.0.sigma=25", "data.path=a.mat", "y=[1, {z=2}]"]);
        let tree = s.tree().unwrap();
        let sigma = &tree["stage"].get_ref()[0].get_ref()["sigma"];
        assert_eq!(s.place(&sigma.span()), Place::Set("stage.0.sigma=25".into()));
        assert_eq!(s.snippet(&sigma.span()), "25");
        assert_eq!(tree["data"].get_ref()["path"].get_ref().as_str(), Some("a.mat"));
        let z = &tree["y"].get_ref()[1].get_ref()["z"];
        assert_eq!(s.snippet(&z.span()), "2");
        assert_eq!(s.place(&tree["x"].span()), Place::Line("./a.toml".into(), 1));
    }

    #[test]
    fn bad_arguments_are_named() {
        for (argument, needle) in [
            ("nothing", "key=value"),
            ("stage.7.sigma=1", "stage.0 to stage.0"),
            ("stage.sigma=1", "not stage.nothing"),
            ("x.y=1", "single value"),
            (".=1", "dotted key"),
        ] {
            let s = source("x = 1\n[[stage]]\nsigma = 50\n", &[argument]);
            let error = s.tree().unwrap_err().to_string();
            assert!(error.starts_with("--set ") && error.contains(needle), "{error}");
        }
    }
}
