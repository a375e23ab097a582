//! Owns where the files and folders that an experiment names are looked for.

use std::env;
use std::ops::Range;
use std::path::{Path, PathBuf};

use super::source::{ConfigError, Source};
use crate::shipped;

/// The environment variable that names a folder of scenes and weights.
pub const DATA_VARIABLE: &str = "SCI_DATA";

/// A path as written.
pub(super) struct Written<'t> {
    /// Dotted key.
    pub(super) key: String,
    pub(super) text: &'t str,
    pub(super) span: Range<usize>,
}

impl<'t> Written<'t> {
    fn at(source: &Source, key: &str, text: &'t str) -> Self {
        Self { key: key.to_owned(), text, span: source.span(key).unwrap_or(0..0) }
    }

    fn error(&self, source: &Source, problem: impl std::fmt::Display) -> ConfigError {
        source.error(&self.span, format!("`{}` = {:?}{problem}", self.key, self.text))
    }
}

/// The folders a relative path is looked up in: that of the file which names it, the current one, and those of the data.
fn search_folders(written: &Written<'_>, source: &Source) -> Vec<PathBuf> {
    let mut folders = vec![source.folder(&written.span), PathBuf::from(".")];
    // What the program brought lies nowhere.
    folders.retain(|folder| !shipped::is_shipped(folder));
    folders.dedup();
    if let Some(data) = env::var_os(DATA_VARIABLE).filter(|v| !v.is_empty()).map(PathBuf::from) {
        folders.extend([data.clone(), data.join("data"), data.join("weights")]);
    }
    folders
}

/// The absolute path of a file or folder.
pub(super) fn locate(written: &Written<'_>, source: &Source) -> Result<PathBuf, ConfigError> {
    let folders = search_folders(written, source);
    // Joining an absolute path gives that path, whatever the folder.
    if let Some(found) = folders.iter().map(|f| f.join(written.text)).find(|p| p.exists()) {
        return std::path::absolute(&found).map_err(|e| written.error(source, format!(": {e}")));
    }
    let mut problem = ": no such file or folder".to_owned();
    if Path::new(written.text).is_relative() {
        let looked: Vec<String> = folders.iter().map(|f| f.display().to_string()).collect();
        problem += &format!("; looked in {}", looked.join(", "));
        if env::var_os(DATA_VARIABLE).is_none_or(|v| v.is_empty()) {
            problem += &format!(" ({DATA_VARIABLE} is not set: it may name a folder with data/ and weights/)");
        }
    }
    Err(written.error(source, problem))
}

/// The absolute path of the file or folder that a dotted key of a source names.
///
/// # Errors
/// If there is none.
pub fn find(source: &Source, key: &str, path: &Path) -> Result<PathBuf, ConfigError> {
    locate(&Written::at(source, key, &path.to_string_lossy()), source)
}

/// The same for weights, which may be `bundled:NAME`.
///
/// # Errors
/// If there are none.
pub fn find_weights(source: &Source, key: &str, path: &Path) -> Result<PathBuf, ConfigError> {
    locate_weights(&Written::at(source, key, &path.to_string_lossy()), source)
}

/// Published weight files by the name under which configs know them: what it is and where it comes from.
const PUBLISHED: [(&str, &str); 3] = [
    (
        "ffdnet_gray_ipol.pth",
        "the gray FFDNet of Tassano, Delon and Veit (IPOL 2019), published as models/net_gray.pth at https://github.com/m-tassano/ffdnet",
    ),
    (
        "ffdnet_gray.pth",
        "the gray FFDNet of Zhang et al., published as ffdnet_gray.pth at https://github.com/cszn/KAIR/releases/tag/v1.0",
    ),
    (
        "ffdnet_color.pth",
        "the color FFDNet of Zhang et al., published as ffdnet_color.pth at https://github.com/cszn/KAIR/releases/tag/v1.0",
    ),
];

/// The absolute path of a weight file, or `bundled:NAME` as it is.
pub(super) fn locate_weights(written: &Written<'_>, source: &Source) -> Result<PathBuf, ConfigError> {
    if let Some(name) = written.text.strip_prefix("bundled:") {
        let known = nets::weights::bundled_names();
        if known.contains(&name) {
            return Ok(PathBuf::from(written.text));
        }
        let legal: Vec<String> = known.iter().map(|n| format!("bundled:{n}")).collect();
        let legal = if legal.is_empty() {
            "no weights are bundled yet".to_owned()
        } else {
            format!("bundled are {}", legal.join(", "))
        };
        let problem = format!(" is not legal: {legal}; name a .pth or .safetensors file");
        return Err(written.error(source, problem));
    }
    locate(written, source).map_err(|mut error| {
        let name = Path::new(written.text).file_name().unwrap_or_default();
        if let Some((name, what)) = PUBLISHED.iter().find(|(n, _)| *n == name) {
            let beside = search_folders(written, source)[0].join(name);
            error.problem += &format!(
                ". It is {what}; save it as {} or as weights/{name} in the folder {DATA_VARIABLE} names",
                beside.display()
            );
        }
        error
    })
}
