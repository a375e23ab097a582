//! Owns the keys of an experiment file: one struct a table, exactly as written, with the place of every value.
//!
//! Tables with a `kind` are read in two steps, kind first, so that each kind is strict about its own keys.

use std::ops::Range;

use serde::Deserialize;
use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::{DeTable, DeValue, ValueDeserializer};

use super::source::{ConfigError, Source};

/// A key's value with its place; the checks say what type and range is legal, in one message.
pub type Value = Option<Spanned<toml::Value>>;

/// Keys outside any table.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct TopKeys {
    pub name: Value,
    pub seed: Value,
    pub schedule: Value,
}

/// `[data]` of either kind; `[data.keys]`, `[data.raw]`, and `[data.mask]` and `[data.noise]` of a simulation are read apart.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct DataKeys {
    pub path: Value,
    pub measurements: Value,
    pub axes: Value,
    pub scale: Value,
    pub cfa: Value,
    pub defects: Value,
    pub mask: Value,
    pub mask_shift: Value,
    pub frames: Value,
}

/// `[data.raw]`: what a file without a header does not say.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct RawKeys {
    pub format: Value,
    pub height: Value,
    pub width: Value,
}

/// `[data.keys]`: the names of a scene's parts in its file.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct PartNames {
    pub mask: Value,
    pub meas: Value,
    pub orig: Value,
    pub rgb: Value,
}

/// `[data.noise]`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct NoiseKeys {
    pub sigma: Value,
    pub photons: Value,
    pub seed: Value,
}

/// `[data.mask]`, `kind = "random"` or `"shifting"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct RandomMaskKeys {
    pub frames: Value,
    pub density: Value,
    pub seed: Value,
}

/// `[data.mask]`, `kind = "file"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct FileMaskKeys {
    pub path: Value,
}

/// `[solver]`, `kind = "gap"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct GapKeys {
    pub accelerate: Value,
    pub momentum: Value,
    pub start: Value,
    pub start_iterations: Value,
    pub start_weight: Value,
    pub demosaicer: Value,
    pub weights: Value,
}

/// `[solver]`, `kind = "admm"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct AdmmKeys {
    pub gamma: Value,
    pub start: Value,
    pub start_iterations: Value,
    pub start_weight: Value,
    pub demosaicer: Value,
    pub weights: Value,
}

/// `[solver]`, `kind = "two-stage"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct TwoStageKeys {
    pub rho: Value,
    pub tau: Value,
    pub convention: Value,
    pub demosaicer: Value,
    pub weights: Value,
    pub clip: Value,
    pub start: Value,
    pub start_iterations: Value,
    pub start_weight: Value,
}

/// `[denoiser]`, `kind = "tv"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct TvKeys {
    pub weight: Value,
    pub inner: Value,
}

/// `[denoiser]`, `kind = "wnnm"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct WnnmKeys {
    pub patch: Value,
    pub group: Value,
    pub step: Value,
    pub window: Value,
    pub frames: Value,
}

/// `[denoiser]`, `kind = "ffdnet"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct NetKeys {
    pub weights: Value,
    pub precision: Value,
    pub flips: Value,
}

/// `[denoiser]`, `kind = "fastdvdnet"`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct VideoNetKeys {
    pub weights: Value,
    pub precision: Value,
    pub flips: Value,
    pub ends: Value,
}

/// One `[[stage]]`, or several of equal length with σ from a list; its own `denoiser` table is read apart.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct StageKeys {
    pub sigma: Value,
    pub iterations: Value,
}

/// `[stop]`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct StopKeys {
    pub relative_change: Value,
    pub seconds: Value,
}

/// `[online]`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct OnlineKeys {
    pub enabled: Value,
    pub preset: Value,
    pub reuse: Value,
    pub effort: Value,
    pub first: Value,
    pub interval: Value,
    pub max_updates: Value,
    pub steps: Value,
    pub stride: Value,
    pub learning_rate: Value,
    pub input_noise: Value,
    pub growth: Value,
    pub parameters: Value,
    pub precision: Value,
    pub held_out: Value,
    pub back_off: Value,
    pub patience: Value,
    pub save: Value,
}

/// `[skip]`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct SkipKeys {
    pub enabled: Value,
    pub spacing: Value,
    pub gain: Value,
    pub patience: Value,
    pub overshoot: Value,
    pub tiles: Value,
    pub half_precision: Value,
    pub cheap_first: Value,
}

/// `[output]`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)]
pub struct OutputKeys {
    pub format: Value,
    pub frames: Value,
    pub preview: Value,
    pub fps: Value,
    pub report: Value,
    pub report_megabytes: Value,
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

    /// Takes out a key that holds the given word where there could be a table; whether it did.
    pub fn take_word(&mut self, key: &str, word: &str) -> bool {
        let found = self.table.get(key).is_some_and(|value| value.get_ref().as_str() == Some(word));
        if found {
            self.table.remove(key);
        }
        found
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
            _ => Err(self.source.error(
                &span,
                format!("`{key}` = {} is not legal; legal: a list of tables, [[{key}]]", self.source.snippet(&span)),
            )),
        }
    }

    fn section(&self, key: String, value: Spanned<DeValue<'s>>) -> Result<Section<'s>, ConfigError> {
        let span = value.span();
        match value.into_inner() {
            DeValue::Table(table) => Ok(Section { source: self.source, key, span, table }),
            _ => Err(self
                .source
                .error(&span, format!("`{key}` = {} is not legal; legal: a table", self.source.snippet(&span)))),
        }
    }

    /// The keys of this table, in their order.
    pub fn keys(&self) -> Vec<String> {
        self.table.keys().map(|k| k.get_ref().to_string()).collect()
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
            _ => Err(self.source.error(
                &span,
                format!("`{key}` = {} is not legal; legal: {}", self.source.snippet(&span), legal.join(", ")),
            )),
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
    /// An unknown key.
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
        self.source.error(&span, format!("`{}`: {message}", self.key))
    }
}

/// The key and the legal keys in serde's "unknown field `a`, expected one of `b`, `c`".
fn unknown_field(message: &str) -> Option<(&str, Vec<&str>)> {
    let mut quoted = message.strip_prefix("unknown field ")?.split('`').skip(1).step_by(2);
    Some((quoted.next()?, quoted.collect()))
}
