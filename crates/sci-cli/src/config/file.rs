//! Owns the keys of an experiment file: one struct a table, exactly as written, with the place of every value.
//!
//! Tables with a `kind` are read in two steps, kind first, so that each kind is strict about its own keys.

use std::ops::Range;

use serde::Deserialize;
use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::{DeTable, DeValue, ValueDeserializer};

use super::source::{ConfigError, Source};

type Value<T> = Option<Spanned<T>>;

/// Keys outside any table.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct TopKeys {
    pub name: Value<String>,
    pub seed: Value<i64>,
}

/// `[data]`, `kind = "scene"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct SceneKeys {
    pub path: Value<String>,
    pub measurements: Option<Spanned<Vec<Spanned<i64>>>>,
    pub keys: Option<PartNames>,
    pub axes: Value<String>,
    pub scale: Value<f64>,
}

/// `[data.keys]`: the names of a scene's parts in its file.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct PartNames {
    pub mask: Option<String>,
    pub meas: Option<String>,
    pub orig: Option<String>,
    pub rgb: Option<String>,
}

/// `[data]`, `kind = "simulate"`; `[data.mask]` is read apart.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct SimulateKeys {
    pub path: Value<String>,
    pub measurements: Option<Spanned<Vec<Spanned<i64>>>>,
    pub keys: Option<PartNames>,
    pub axes: Value<String>,
    pub scale: Value<f64>,
    pub noise: Option<NoiseKeys>,
}

/// `[data.noise]`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct NoiseKeys {
    pub sigma: Value<f64>,
    pub photons: Value<f64>,
    pub seed: Value<i64>,
}

/// `[data.mask]`, `kind = "random"` or `"shifting"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct RandomMaskKeys {
    pub frames: Value<i64>,
    pub density: Value<f64>,
    pub seed: Value<i64>,
}

/// `[data.mask]`, `kind = "file"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct FileMaskKeys {
    pub path: Value<String>,
}

/// `[solver]`, `kind = "gap"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct GapKeys {
    pub accelerate: Value<bool>,
    pub momentum: Value<String>,
    pub start: Value<String>,
    pub start_iterations: Value<i64>,
    pub start_weight: Value<f64>,
}

/// `[solver]`, `kind = "admm"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct AdmmKeys {
    pub gamma: Value<f64>,
    pub start: Value<String>,
    pub start_iterations: Value<i64>,
    pub start_weight: Value<f64>,
}

/// `[denoiser]`, `kind = "tv"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct TvKeys {
    pub weight: Value<f64>,
    pub inner: Value<i64>,
    pub warm_dual: Value<bool>,
}

/// `[denoiser]`, `kind = "ffdnet"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct NetKeys {
    pub weights: Value<String>,
}

/// One `[[stage]]`; its own `denoiser` table is read apart.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct StageKeys {
    pub sigma: Value<f64>,
    pub iterations: Value<i64>,
}

/// `[stop]`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct StopKeys {
    pub relative_change: Value<f64>,
    pub seconds: Value<f64>,
}

/// `[skip]` and `[online]`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct SwitchKeys {
    pub enabled: Value<bool>,
}

/// `[output]`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct OutputKeys {
    pub format: Value<String>,
    pub frames: Value<bool>,
    pub preview: Value<bool>,
    pub fps: Value<i64>,
}

/// A table on its way to a struct: its dotted key, its span, and what has not been taken out of it yet.
#[derive(Debug)]
pub struct Section<'s> {
    source: &'s Source,
    /// Dotted key, empty for the root.
    pub key: String,
    /// Where it is, for errors about what it lacks.
    pub span: Range<usize>,
    table: DeTable<'s>,
}

impl<'s> Section<'s> {
    /// The whole experiment.
    ///
    /// # Errors
    /// As [`Source::tree`].
    pub fn root(source: &'s Source) -> Result<Self, ConfigError> {
        Ok(Self { source, key: String::new(), span: 0..0, table: source.tree()? })
    }

    /// The dotted key of a key of this table.
    pub fn key_of(&self, key: &str) -> String {
        if self.key.is_empty() { key.to_owned() } else { format!("{}.{key}", self.key) }
    }

    /// Takes out a sub-table.
    ///
    /// # Errors
    /// If the key holds something else.
    pub fn take(&mut self, key: &str) -> Result<Option<Section<'s>>, ConfigError> {
        let Some((_, value)) = self.table.remove_entry(key) else { return Ok(None) };
        self.section(self.key_of(key), value).map(Some)
    }

    /// Takes out a list of tables.
    ///
    /// # Errors
    /// If the key holds something else.
    pub fn take_list(&mut self, key: &str) -> Result<Vec<Section<'s>>, ConfigError> {
        let Some((_, value)) = self.table.remove_entry(key) else { return Ok(Vec::new()) };
        let span = value.span();
        match value.into_inner() {
            DeValue::Array(list) => list
                .into_iter()
                .enumerate()
                .map(|(i, v)| self.section(format!("{}.{i}", self.key_of(key)), v))
                .collect(),
            _ => Err(self.source.error(&span, format!("`{key}` is a list of tables: write [[{key}]]"))),
        }
    }

    fn section(&self, key: String, value: Spanned<DeValue<'s>>) -> Result<Section<'s>, ConfigError> {
        let span = value.span();
        match value.into_inner() {
            DeValue::Table(table) => Ok(Section { source: self.source, key, span, table }),
            other => Err(self.source.error(
                &span,
                format!("`{key}` = {} is a {}, expected a table", self.source.snippet(&span), other.type_str()),
            )),
        }
    }

    /// Takes out `kind`, which must be one of `legal`.
    ///
    /// # Errors
    /// If it is none of them, or missing and there is no default.
    pub fn take_kind(&mut self, legal: &[&str], default: Option<&str>) -> Result<Spanned<String>, ConfigError> {
        let key = self.key_of("kind");
        let Some((_, value)) = self.table.remove_entry("kind") else {
            return match default {
                Some(kind) => Ok(Spanned::new(self.span.clone(), kind.to_owned())),
                None => Err(self.source.error(&self.span, format!("`{key}` is missing; legal: {}", legal.join(", ")))),
            };
        };
        let span = value.span();
        match value.get_ref().as_str() {
            Some(kind) if legal.contains(&kind) => Ok(Spanned::new(span, kind.to_owned())),
            _ => Err(self
                .source
                .error(&span, format!("`{key}` = {}; legal: {}", self.source.snippet(&span), legal.join(", ")))),
        }
    }

    /// Refuses keys that are none of `legal`.
    ///
    /// # Errors
    /// Names the first such key.
    pub fn only(&self, legal: &[&str]) -> Result<(), ConfigError> {
        match self.table.iter().find(|(key, _)| !legal.contains(&key.get_ref().as_ref())) {
            None => Ok(()),
            Some((key, _)) => Err(self.unknown(&key.span(), key.get_ref().as_ref(), legal)),
        }
    }

    fn unknown(&self, span: &Range<usize>, key: &str, legal: &[&str]) -> ConfigError {
        let near = legal
            .iter()
            .map(|l| (strsim::damerau_levenshtein(l, key), l))
            .filter(|(distance, _)| *distance <= 2)
            .min()
            .map_or(String::new(), |(_, l)| format!(" (did you mean `{l}`?)"));
        let legal = if legal.is_empty() { "none".to_owned() } else { legal.join(", ") };
        self.source.error(span, format!("unknown key `{}`{near}; legal here: {legal}", self.key_of(key)))
    }

    /// Reads what is left into a struct that knows all its keys; `also` are keys taken out before.
    ///
    /// # Errors
    /// An unknown key or a value of the wrong type.
    pub fn read<T: DeserializeOwned>(self, also: &[&str]) -> Result<T, ConfigError> {
        let table = self.table.clone();
        let value = Spanned::new(self.span.clone(), DeValue::Table(table));
        T::deserialize(ValueDeserializer::from(value)).map_err(|e| self.explain(&e, also))
    }

    fn explain(&self, error: &toml::de::Error, also: &[&str]) -> ConfigError {
        let span = error.span().unwrap_or(self.span.clone());
        let message = error.message();
        if let Some((key, legal)) = unknown_field(message) {
            let legal: Vec<&str> = legal.into_iter().chain(also.iter().copied()).collect();
            return self.unknown(&span, key, &legal);
        }
        let (path, span) = find(&self.table, &span).unwrap_or((String::new(), span));
        let key = if path.is_empty() { self.key.clone() } else { self.key_of(&path) };
        let expected = message.rsplit_once("expected ").map_or(message, |(_, e)| e);
        let expected = match expected {
            "i64" => "a whole number",
            "f64" => "a number",
            "a string" => "text in quotes",
            "a boolean" => "true or false",
            other => other.trim_start_matches("struct "),
        };
        self.source
            .error(&span, format!("`{key}` = {} is of the wrong type: expected {expected}", self.source.snippet(&span)))
    }
}

/// The key and the legal keys in serde's "unknown field `a`, expected one of `b`, `c`".
fn unknown_field(message: &str) -> Option<(&str, Vec<&str>)> {
    let mut quoted = message.strip_prefix("unknown field ")?.split('`').skip(1).step_by(2);
    Some((quoted.next()?, quoted.collect()))
}

/// The dotted key and span of the innermost value that covers a span.
fn find(table: &DeTable<'_>, span: &Range<usize>) -> Option<(String, Range<usize>)> {
    let covers = |outer: Range<usize>| outer.start <= span.start && span.end <= outer.end;
    let below = |value: &Spanned<DeValue<'_>>| match value.get_ref() {
        DeValue::Table(inner) => find(inner, span),
        DeValue::Array(list) => {
            list.iter().enumerate().find(|(_, v)| covers(v.span())).map(|(i, v)| (i.to_string(), v.span()))
        }
        _ => None,
    };
    table.iter().find_map(|(key, value)| {
        let key = key.get_ref().as_ref();
        match below(value) {
            Some((path, span)) => Some((format!("{key}.{path}"), span)),
            None if covers(value.span()) => Some((key.to_owned(), value.span())),
            None => None,
        }
    })
}
