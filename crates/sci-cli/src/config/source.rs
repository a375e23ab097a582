//! Owns the text of an experiment: the file and the `--set` arguments as one tree that remembers where each value came from.
//!
//! All texts are joined into one string and every span points into it, so that a value, wherever it came from, can be
//! reported with its file and line or with its argument.

use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};

use toml::Spanned;
use toml::de::{DeArray, DeTable, DeValue};

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

/// The file's path, and the joined text of the file and all `--set` arguments.
#[derive(Clone, Debug)]
pub struct Source {
    path: PathBuf,
    text: String,
    file_len: usize,
    /// Byte range of each argument in `text`.
    arguments: Vec<Range<usize>>,
}

impl Source {
    /// Joins a file's text and the `--set` arguments.
    pub fn new(path: &Path, file: &str, arguments: &[String]) -> Self {
        let mut text = file.to_owned();
        let mut ranges = Vec::new();
        for argument in arguments {
            text.push('\n');
            let start = text.len();
            text.push_str(argument);
            ranges.push(start..text.len());
        }
        Self { path: path.to_owned(), text, file_len: file.len(), arguments: ranges }
    }

    /// The file's path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether a span lies in a `--set` argument.
    pub fn is_set(&self, span: &Range<usize>) -> bool {
        self.arguments.iter().any(|a| a.start <= span.start && span.start <= a.end)
    }

    /// The place of a span.
    pub fn place(&self, span: &Range<usize>) -> Place {
        if let Some(a) = self.arguments.iter().find(|a| a.start <= span.start && span.start <= a.end) {
            return Place::Set(self.text[a.clone()].to_owned());
        }
        let end = span.start.min(self.file_len);
        Place::Line(self.path.clone(), 1 + self.text.as_bytes()[..end].iter().filter(|&&b| b == b'\n').count())
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

    /// An error about the file as a whole.
    pub fn file_error(&self, problem: impl Into<String>) -> ConfigError {
        ConfigError { place: Place::File(self.path.clone()), problem: problem.into() }
    }

    /// Parses the file and applies the arguments in order.
    ///
    /// # Errors
    /// TOML that does not parse, an argument without `=`, or a key path that leads nowhere.
    pub fn tree(&self) -> Result<DeTable<'_>, ConfigError> {
        let file = &self.text[..self.file_len];
        let mut root = DeTable::parse(file)
            .map_err(|e| {
                let span = e.span().unwrap_or(0..0);
                self.error(&span, format!("not valid TOML: {}", e.message().replace('\n', ", ")))
            })?
            .into_inner();
        for range in &self.arguments {
            self.apply(&mut root, range)?;
        }
        Ok(root)
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

/// Moves every span of a value parsed from a part of the text.
fn shift(value: Spanned<DeValue<'_>>, by: usize) -> Spanned<DeValue<'_>> {
    let span = value.span();
    let inner = match value.into_inner() {
        DeValue::Array(list) => DeValue::Array(list.into_iter().map(|v| shift(v, by)).collect()),
        DeValue::Table(table) => DeValue::Table(
            table
                .into_iter()
                .map(|(k, v)| {
                    let key = k.span();
                    (Spanned::new(key.start + by..key.end + by, k.into_inner()), shift(v, by))
                })
                .collect(),
        ),
        other => other,
    };
    Spanned::new(span.start + by..span.end + by, inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(file: &str, arguments: &[&str]) -> Source {
        Source::new(Path::new("a.toml"), file, &arguments.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>())
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
        assert_eq!(s.place(&tree["x"].span()), Place::Line("a.toml".into(), 1));
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
