//! Owns how the tables of a TOML file are read: a [`Table`] is asked for each of its keys by name, default and range.
//!
//! What was asked is all that a table may hold, and all that the record shows of it: there is no other list of keys. A mistake does not
//! end the reading, so that a key with a wrong name is told by all the right ones; [`Table::read`] then reports the first.

mod paths;
pub mod source;

use std::ops::{Range, RangeInclusive};
use std::path::PathBuf;

use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value as Json};
use toml::de::{DeTable, DeValue, ValueDeserializer};
use toml::{Spanned, Value};

pub use paths::{DATA_VARIABLE, find, find_weights};
pub use source::{ConfigError, Place, Source};

/// Full scale of a σ in a file.
const SIGMA_UNIT: f32 = 255.0;
/// Legal σ, in units of an 8-bit picture.
pub const SIGMAS: RangeInclusive<f64> = 0.0..=255.0;
/// The most iterations of anything.
pub const MAX_ITERATIONS: usize = 100_000;
const SEEDS: RangeInclusive<i64> = 0..=i64::MAX;

/// σ in `[0, 1]`.
pub fn sigma(in_file: f64) -> f32 {
    in_file as f32 / SIGMA_UNIT
}

/// What to do about the files and folders that an experiment names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Paths {
    /// Nothing: only what the file says is checked.
    AsWritten,
    /// Find them.
    LookedUp,
    /// Find all but the files of the scene, which is in memory.
    AllButScene,
}

impl Paths {
    /// Whether what is named under a dotted key must be there.
    fn looks_up(self, key: &str) -> bool {
        match self {
            Self::AsWritten => false,
            Self::LookedUp => true,
            Self::AllButScene => !["data.path", "data.mask"].contains(&key),
        }
    }
}

/// A table while it is read.
#[derive(Debug)]
pub struct Table<'s> {
    source: &'s Source,
    paths: Paths,
    /// Dotted key, empty for the root.
    key: String,
    /// Where it is, for errors about what it lacks.
    span: Range<usize>,
    /// What has not been asked for yet.
    rest: DeTable<'s>,
    /// The names that were asked for, with the place of what was there.
    asked: Vec<(String, Option<Range<usize>>)>,
    /// The first mistake.
    mistake: Option<ConfigError>,
    /// What was found, defaults filled in.
    json: Map<String, Json>,
}

impl<'s> Table<'s> {
    /// The whole file.
    ///
    /// # Errors
    /// As [`Source::tree`].
    pub fn root(source: &'s Source, paths: Paths) -> Result<Self, ConfigError> {
        Ok(Self::new(source, paths, String::new(), 0..0, source.tree()?))
    }

    fn new(source: &'s Source, paths: Paths, key: String, span: Range<usize>, rest: DeTable<'s>) -> Self {
        Self { source, paths, key, span, rest, asked: Vec::new(), mistake: None, json: Map::new() }
    }

    /// Reads the table by `read`; with the result comes what the record shows of it.
    ///
    /// # Errors
    /// The first key that was not asked for, else the first mistake.
    pub fn read<T>(mut self, read: impl FnOnce(&mut Self) -> Result<T, ConfigError>) -> Result<(T, Json), ConfigError> {
        let value = read(&mut self)?;
        if let Some((key, _)) = self.rest.iter().next() {
            return Err(self.unknown(&key.span(), key.get_ref().as_ref()));
        }
        match self.mistake {
            Some(mistake) => Err(mistake),
            None => Ok((value, Json::Object(self.json))),
        }
    }

    /// Its own dotted key.
    pub fn key(&self) -> &str {
        &self.key
    }

    /// The dotted key of a key of this table.
    pub fn key_of(&self, key: &str) -> String {
        if self.key.is_empty() { key.to_owned() } else { format!("{}.{key}", self.key) }
    }

    /// Whether a key is there that has not been asked for.
    pub fn holds(&mut self, key: &str) -> bool {
        let place = self.rest.get(key).map(Spanned::span);
        // Whoever has asked already has taken it.
        if self.place_of(key).is_none() {
            self.asked.push((key.to_owned(), place.clone()));
        }
        place.is_some()
    }

    /// The keys that have not been asked for.
    pub fn keys(&self) -> Vec<String> {
        self.rest.keys().map(|k| k.get_ref().to_string()).collect()
    }

    /// Notes a mistake at a key that was asked for, or of the table if the key is not there.
    pub fn refuse(&mut self, key: &str, problem: &str) {
        let span = self.place_of(key).unwrap_or_else(|| self.span.clone());
        let problem = format!("`{}` {problem}", self.key_of(key));
        self.note(self.source.error(&span, problem));
    }

    /// A mistake of the table as a whole.
    pub fn error(&self, problem: impl Into<String>) -> ConfigError {
        self.source.error(&self.span, problem)
    }

    /// Notes a mistake of the table as a whole.
    pub fn complain(&mut self, problem: impl Into<String>) {
        self.note(self.error(problem));
    }

    /// Asks for a key whose value does not matter; whether it is there.
    pub fn given(&mut self, key: &str) -> bool {
        self.take(key).is_some()
    }

    /// Asks for keys that mean nothing without something else: none may be there.
    pub fn idle(&mut self, keys: &[&str], without: &str) {
        for key in keys {
            if self.given(key) {
                self.refuse(key, &format!("has no effect without {without}"));
            }
        }
    }

    /// A number.
    pub fn number(&mut self, key: &str, default: f64, range: RangeInclusive<f64>) -> f64 {
        let found = self.find_number(key, &range, "").unwrap_or(default);
        self.show(key, found);
        found
    }

    /// A number that may be left out.
    pub fn optional_number(&mut self, key: &str, range: RangeInclusive<f64>) -> Option<f64> {
        let found = self.find_number(key, &range, "");
        self.show(key, found);
        found
    }

    /// A σ, which files give in units of an 8-bit picture; the default and the result are in `[0, 1]`.
    pub fn sigma(&mut self, key: &str, default: f32) -> f32 {
        let found = self.find_number(key, &SIGMAS, UNIT).map_or(default, sigma);
        self.show(key, found);
        found
    }

    /// A whole number.
    pub fn whole(&mut self, key: &str, default: usize, range: RangeInclusive<usize>) -> usize {
        let found = self.optional_whole(key, range).unwrap_or(default);
        self.show(key, found);
        found
    }

    /// A whole number that may be left out.
    pub fn optional_whole(&mut self, key: &str, range: RangeInclusive<usize>) -> Option<usize> {
        let legal = format!("a whole number from {} to {}", range.start(), range.end());
        let number = |v: &Value| v.as_integer().and_then(|i| usize::try_from(i).ok()).filter(|i| range.contains(i));
        let found = self.legal(key, &legal, number);
        self.show(key, found);
        found
    }

    /// A whole number that must be there.
    pub fn required_whole(&mut self, key: &str, range: RangeInclusive<usize>) -> usize {
        let missing = format!("is missing; legal: {} to {}", range.start(), range.end());
        let found = self.optional_whole(key, range);
        if self.place_of(key).is_none() {
            self.refuse(key, &missing);
        }
        found.unwrap_or_default()
    }

    /// What something random begins with.
    pub fn seed(&mut self, key: &str, default: u64) -> u64 {
        let legal = format!("a whole number of at least {}", SEEDS.start());
        let found = self.legal(key, &legal, |v| v.as_integer().filter(|i| SEEDS.contains(i)));
        let seed = found.map_or(default, |seed| seed as u64);
        self.show(key, seed);
        seed
    }

    /// True or false.
    pub fn flag(&mut self, key: &str, default: bool) -> bool {
        let found = self.legal(key, "true or false", Value::as_bool).unwrap_or(default);
        self.show(key, found);
        found
    }

    /// A text that `ok` finds legal.
    pub fn text(&mut self, key: &str, legal: &str, ok: impl Fn(&str) -> bool) -> Option<String> {
        let found = self.legal(key, legal, |v| v.as_str().filter(|t| ok(t)).map(str::to_owned));
        self.show(key, found.clone());
        found
    }

    /// One of several names.
    pub fn choice<T: Copy + PartialEq>(&mut self, key: &str, legal: &[(&str, T)], default: T) -> T {
        let found = self.optional_choice(key, legal).unwrap_or(default);
        self.show(key, legal.iter().find(|(_, choice)| *choice == found).map(|(name, _)| *name));
        found
    }

    /// One of several names, which may be left out.
    pub fn optional_choice<T: Copy>(&mut self, key: &str, legal: &[(&str, T)]) -> Option<T> {
        let names: Vec<&str> = legal.iter().map(|(name, _)| *name).collect();
        let named = |v: &Value| legal.iter().find(|(name, _)| v.as_str() == Some(name)).copied();
        let found = self.legal(key, &names.join(", "), named);
        self.show(key, found.map(|(name, _)| name));
        found.map(|(_, choice)| choice)
    }

    /// A file or folder that must be there.
    pub fn path(&mut self, key: &str) -> PathBuf {
        self.located(key, paths::locate)
    }

    /// The weights of a network: a file, or `bundled:NAME`.
    pub fn weights(&mut self, key: &str) -> PathBuf {
        self.located(key, paths::locate_weights)
    }

    fn located(
        &mut self,
        key: &str,
        locate: fn(&paths::Written<'_>, &Source) -> Result<PathBuf, ConfigError>,
    ) -> PathBuf {
        let legal = "the path of a file or folder, in quotes";
        let text = self.text(key, legal, |p| !p.is_empty());
        let found = match (self.place_of(key), text) {
            (None, _) => Err(self.error(format!("`{}` is missing; legal: {legal}", self.key_of(key)))),
            (Some(span), Some(text)) if self.paths.looks_up(&self.key_of(key)) => {
                locate(&paths::Written { key: self.key_of(key), text: &text, span }, self.source)
            }
            (Some(_), text) => Ok(PathBuf::from(text.unwrap_or_default())),
        };
        let path = found.unwrap_or_else(|mistake| {
            self.note(mistake);
            PathBuf::new()
        });
        self.show(key, path.to_string_lossy());
        path
    }

    /// The value of a key, if it is there and `read` finds it legal. The record is not told.
    pub fn legal<T>(&mut self, key: &str, legal: &str, read: impl FnOnce(&Value) -> Option<T>) -> Option<T> {
        let value = self.take(key)?;
        let span = value.span();
        // What TOML's own types cannot hold is not legal either.
        let found = Value::deserialize(ValueDeserializer::from(value)).ok().and_then(|value| read(&value));
        if found.is_none() {
            self.note(self.source.not_legal(&span, &self.key_of(key), legal));
        }
        found
    }

    fn find_number(&mut self, key: &str, range: &RangeInclusive<f64>, unit: &str) -> Option<f64> {
        let legal = format!("a number from {} to {}{unit}", range.start(), range.end());
        self.legal(key, &legal, |v| as_number(v).filter(|x| range.contains(x)))
    }

    /// The `kind` of the table, one of `legal`, on which depends what else may be in it.
    ///
    /// # Errors
    /// If it is none of them, or missing and there is no default.
    pub fn kind<'k>(&mut self, legal: &[&'k str], default: Option<&'k str>) -> Result<&'k str, ConfigError> {
        Ok(legal[self.which_kind(legal, default)?])
    }

    /// The entry of a list of all kinds whose `name` is the table's `kind`.
    ///
    /// # Errors
    /// As [`Table::kind`].
    pub fn entry<'e, E>(&mut self, entries: &'e [E], name: impl Fn(&E) -> &'static str) -> Result<&'e E, ConfigError> {
        let kinds: Vec<&str> = entries.iter().map(name).collect();
        Ok(&entries[self.which_kind(&kinds, None)?])
    }

    fn which_kind(&mut self, legal: &[&str], default: Option<&str>) -> Result<usize, ConfigError> {
        let key = self.key_of("kind");
        let of = |name: Option<&str>| legal.iter().position(|kind| name == Some(kind));
        let which = match self.take("kind") {
            None => {
                of(default).ok_or_else(|| self.error(format!("`{key}` is missing; legal: {}", legal.join(", "))))?
            }
            Some(value) => of(value.get_ref().as_str())
                .ok_or_else(|| self.source.not_legal(&value.span(), &key, &legal.join(", ")))?,
        };
        self.show("kind", legal[which]);
        Ok(which)
    }

    /// A table in this one.
    ///
    /// # Errors
    /// If the key holds something else.
    pub fn table(&mut self, key: &str) -> Result<Option<Table<'s>>, ConfigError> {
        self.take(key).map(|value| self.section(self.key_of(key), value)).transpose()
    }

    /// A table in this one; an empty one if there is none.
    ///
    /// # Errors
    /// If the key holds something else.
    pub fn table_or_empty(&mut self, key: &str) -> Result<Table<'s>, ConfigError> {
        let empty = Self::new(self.source, self.paths, self.key_of(key), self.span.clone(), DeTable::new());
        Ok(self.table(key)?.unwrap_or(empty))
    }

    /// Reads a table in this one by `read`, an empty one if there is none.
    ///
    /// # Errors
    /// As [`Table::read`].
    pub fn part<T>(
        &mut self,
        key: &str,
        read: impl FnOnce(&mut Self) -> Result<T, ConfigError>,
    ) -> Result<T, ConfigError> {
        let (value, json) = self.table_or_empty(key)?.read(read)?;
        self.show(key, json);
        Ok(value)
    }

    /// A list of tables.
    ///
    /// # Errors
    /// If the key holds something else.
    pub fn list(&mut self, key: &str) -> Result<Vec<Table<'s>>, ConfigError> {
        let Some(value) = self.take(key) else { return Ok(Vec::new()) };
        let (span, path) = (value.span(), self.key_of(key));
        let DeValue::Array(list) = value.into_inner() else {
            return Err(self.source.not_legal(&span, key, &format!("a list of tables, [[{key}]]")));
        };
        list.into_iter().enumerate().map(|(i, value)| self.section(format!("{path}.{i}"), value)).collect()
    }

    /// Whether a key that has not been asked for holds a list.
    pub fn holds_list(&self, key: &str) -> bool {
        self.rest.get(key).is_some_and(|value| value.get_ref().as_array().is_some())
    }

    /// Whether a key holds this word where there could be a table.
    pub fn word(&mut self, key: &str, word: &str) -> bool {
        let found = self.holds(key) && self.rest.get(key).is_some_and(|value| value.get_ref().as_str() == Some(word));
        if found {
            self.rest.remove(key);
        }
        found
    }

    fn section(&self, key: String, value: Spanned<DeValue<'s>>) -> Result<Table<'s>, ConfigError> {
        let span = value.span();
        match value.into_inner() {
            DeValue::Table(table) => Ok(Self::new(self.source, self.paths, key, span, table)),
            _ => Err(self.source.not_legal(&span, &key, "a table")),
        }
    }

    /// Reads the whole table into a type of serde's.
    ///
    /// # Errors
    /// What serde reports, at its place.
    pub fn deserialize<T: DeserializeOwned>(mut self) -> Result<T, ConfigError> {
        let value = Spanned::new(self.span.clone(), DeValue::Table(std::mem::take(&mut self.rest)));
        T::deserialize(ValueDeserializer::from(value)).map_err(|e| {
            let (span, message) = (e.span().unwrap_or(0..0), e.message());
            let Some((key, legal)) = unknown_field(message) else { return self.source.mismatch(&span, message) };
            self.asked = legal.into_iter().map(|name| (name.to_owned(), None)).collect();
            self.unknown(&span, key)
        })
    }

    fn take(&mut self, key: &str) -> Option<Spanned<DeValue<'s>>> {
        let value = self.rest.remove(key);
        self.asked.push((key.to_owned(), value.as_ref().map(Spanned::span)));
        value
    }

    fn place_of(&self, key: &str) -> Option<Range<usize>> {
        self.asked.iter().rev().find(|(asked, _)| asked == key)?.1.clone()
    }

    /// Puts what is not as it was written into the record.
    pub fn show(&mut self, key: &str, value: impl Into<Json>) {
        self.json.insert(key.to_owned(), value.into());
    }

    fn note(&mut self, mistake: ConfigError) {
        self.mistake.get_or_insert(mistake);
    }

    fn unknown(&self, span: &Range<usize>, key: &str) -> ConfigError {
        let mut legal: Vec<&str> = Vec::new();
        for (name, _) in &self.asked {
            if !legal.contains(&name.as_str()) {
                legal.push(name);
            }
        }
        let distances = legal.iter().map(|l| (strsim::damerau_levenshtein(l, key), l));
        let near = distances.filter(|(distance, _)| *distance <= 2).min();
        let near = near.map_or(String::new(), |(_, l)| format!(" (did you mean `{l}`?)"));
        let legal = if legal.is_empty() { "none".to_owned() } else { legal.join(", ") };
        self.source.error(span, format!("unknown key `{}`{near}; legal here: {legal}", self.key_of(key)))
    }
}

const UNIT: &str = ", in units of an 8-bit picture";

/// A number of either kind.
pub fn as_number(value: &Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|i| i as f64))
}

/// The key and the legal keys in serde's "unknown field `a`, expected one of `b`, `c`".
fn unknown_field(message: &str) -> Option<(&str, Vec<&str>)> {
    let mut quoted = message.strip_prefix("unknown field ")?.split('`').skip(1).step_by(2);
    Some((quoted.next()?, quoted.collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read<T>(
        text: &str,
        read: impl FnOnce(&mut Table<'_>) -> Result<T, ConfigError>,
    ) -> Result<(T, Json), ConfigError> {
        let source = Source::new("a.toml".as_ref(), text, &[], &|_| Err("none".into()))?;
        Table::root(&source, Paths::AsWritten)?.read(read)
    }

    #[test]
    fn what_is_left_over_is_told_by_all_that_was_asked_for() {
        let keys = |t: &mut Table<'_>| {
            let weight = t.number("weight", 0.3, 0.0..=1.0);
            let count = t.required_whole("count", 1..=9);
            Ok((weight, count, t.part("inner", |t| Ok(t.flag("on", true)))?))
        };
        let problem = |text: &str| read(text, keys).unwrap_err().to_string();
        // A key with a wrong name is told before those that are missing and wrong.
        let unknown = "a.toml:2: unknown key `counts` (did you mean `count`?); legal here: weight, count, inner";
        assert_eq!(problem("weight = 7\ncounts = 2"), unknown);
        assert_eq!(problem("weight = 7"), "a.toml:1: `weight` = 7 is not legal; legal: a number from 0 to 1");
        assert_eq!(problem("weight = 1"), "a.toml:1: `count` is missing; legal: 1 to 9");
        // What was only looked for counts too.
        let source = Source::new("a.toml".as_ref(), "maks = 1", &[], &|_| Err("none".into())).unwrap();
        let looked =
            Table::root(&source, Paths::AsWritten).unwrap().read(|t| Ok((t.holds("mask"), t.word("noise", "auto"))));
        assert!(looked.unwrap_err().to_string().ends_with("`maks` (did you mean `mask`?); legal here: mask, noise"));
        assert_eq!(problem("count = 2\ninner.other = 1"), "a.toml:2: unknown key `inner.other`; legal here: on");
        let (values, json) = read("count = 2", keys).unwrap();
        assert_eq!(values, (0.3, 2, true));
        assert_eq!(json, serde_json::json!({ "weight": 0.3, "count": 2, "inner": { "on": true } }));
    }

    #[test]
    fn numbers_beyond_those_of_toml_are_not_legal() {
        let problem = read("count = 99999999999999999999", |t| Ok(t.optional_whole("count", 0..=9))).unwrap_err();
        assert!(problem.problem.contains("`count` = 99999999999999999999 is not legal"), "{problem}");
    }

    #[test]
    fn what_means_nothing_is_refused() {
        let keys = |t: &mut Table<'_>| {
            let on = t.flag("on", false);
            if on {
                t.number("strength", 1.0, 0.0..=2.0);
            } else {
                t.idle(&["strength"], "on = true");
            }
            Ok(())
        };
        assert_eq!(read("", keys).unwrap().1, serde_json::json!({ "on": false }));
        assert_eq!(read("on = true", keys).unwrap().1, serde_json::json!({ "on": true, "strength": 1.0 }));
        let error = read("strength = 2", keys).unwrap_err().to_string();
        assert_eq!(error, "a.toml:1: `strength` has no effect without on = true");
    }
}
