//! Finds the picture that a row of a table means.
//!
//! Exact relative paths come first. Then, wherever only one picture and one row fit: another case, no extension,
//! a leading folder or an absolute path, and at last the name of the file alone. A row that fits several pictures
//! fits none.

use std::collections::HashMap;
use std::path::Path;

use serde::{Deserialize, Serialize};
use unicode_normalization::UnicodeNormalization;

use crate::folder::is_picture_name;

/// How a row names its picture, unless by its exact relative path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MatchKind {
    /// By its path, up to `\`, `./` and the form of accents.
    Path,
    /// In another case.
    OtherCase,
    /// Without its extension.
    NoExtension,
    /// With more or fewer folders before it.
    Folder,
    /// By the name of the file alone.
    BaseName,
}

impl MatchKind {
    /// Completes the sentence "rows name their pictures …".
    pub(super) fn how(self) -> &'static str {
        match self {
            Self::Path => "by their paths",
            Self::OtherCase => "in another case",
            Self::NoExtension => "without the extension",
            Self::Folder => "with other leading folders",
            Self::BaseName => "by the name of the file alone, which is unique",
        }
    }
}

/// The picture of each row: its index, or why there is none.
pub(super) type Matches = Vec<Result<(usize, MatchKind), String>>;

/// Finds the picture of each row. The names of the rows are distinct.
pub(super) fn match_rows(rows: &[&str], pictures: &[&str], dir: &Path) -> Matches {
    let mut matcher = Matcher {
        rows: rows.iter().map(|row| components(row)).collect(),
        pictures: pictures.iter().map(|picture| components(picture)).collect(),
        found: vec![None; rows.len()],
        taken: vec![None; pictures.len()],
        ambiguous: vec![None; rows.len()],
    };
    matcher.verbatim(rows, pictures);
    matcher.whole_paths(0, 0, MatchKind::Path);
    let absolute: Vec<usize> = dir
        .canonicalize()
        .iter()
        .chain([&dir.to_owned()])
        .map(|dir| components(&dir.to_string_lossy()))
        .filter(|dir| !dir.is_empty() && matcher.rows.iter().any(|row| row.starts_with(dir)))
        .map(|dir| dir.len())
        .collect();
    for folders in absolute {
        matcher.whole_paths(folders, 0, MatchKind::Path);
    }
    for folders in 1..=common_folders(&matcher.rows) {
        matcher.whole_paths(folders, 0, MatchKind::Folder);
    }
    for folders in 1..=common_folders(&matcher.pictures) {
        matcher.whole_paths(0, folders, MatchKind::Folder);
    }
    for transform in Transform::ALL {
        matcher.ends(transform);
    }
    matcher.into_matches(pictures)
}

/// Splits a path into its parts, without `.`, drive and scheme, and with accents in one form.
fn components(path: &str) -> Vec<String> {
    let path: String = path.nfc().collect();
    let path = path.strip_prefix("file://").unwrap_or(&path).replace('\\', "/");
    let mut parts: Vec<String> = Vec::new();
    for part in path.split('/') {
        match part {
            "" | "." => {}
            ".." => drop(parts.pop()),
            drive if parts.is_empty() && drive.len() == 2 && drive.ends_with(':') => {}
            part => parts.push(part.to_owned()),
        }
    }
    parts
}

/// The number of leading folders that all paths have in common.
fn common_folders(paths: &[Vec<String>]) -> usize {
    let Some(first) = paths.first() else { return 0 };
    let folders = |path: &Vec<String>| path.len().saturating_sub(1);
    let shared = |path: &Vec<String>| first.iter().zip(path).take_while(|(a, b)| a == b).count();
    paths.iter().map(|path| shared(path).min(folders(path))).min().unwrap_or(0)
}

/// What is disregarded in a comparison.
#[derive(Debug, Clone, Copy)]
struct Transform {
    case: bool,
    extension: bool,
}

impl Transform {
    const ALL: [Self; 4] = [
        Self { case: false, extension: false },
        Self { case: true, extension: false },
        Self { case: false, extension: true },
        Self { case: true, extension: true },
    ];

    fn kind(self, otherwise: MatchKind) -> MatchKind {
        let of = match (self.case, self.extension) {
            (_, true) => MatchKind::NoExtension,
            (true, false) => MatchKind::OtherCase,
            (false, false) => MatchKind::Path,
        };
        of.max(otherwise)
    }

    /// The key of a path; `None` if the transform does not apply to it.
    fn key(self, path: &[String], is_row: bool) -> Option<String> {
        let (name, folders) = path.split_last()?;
        let mut name = name.as_str();
        if self.extension {
            match is_row {
                // Only rows without an extension; another one may be another picture.
                true if is_picture_name(Path::new(name)) => return None,
                true => {}
                false => name = name.rsplit_once('.').map_or(name, |(stem, _)| stem),
            }
        }
        let mut key = folders.join("/");
        key.push('/');
        key.push_str(name);
        Some(if self.case { key.to_lowercase() } else { key })
    }
}

struct Matcher {
    rows: Vec<Vec<String>>,
    pictures: Vec<Vec<String>>,
    found: Vec<Option<(usize, MatchKind)>>,
    /// The row of each picture.
    taken: Vec<Option<usize>>,
    /// Pictures that fit a row, if it is not clear which one is meant.
    ambiguous: Vec<Option<Vec<usize>>>,
}

impl Matcher {
    fn assign(&mut self, row: usize, picture: usize, kind: MatchKind) {
        self.found[row] = Some((picture, kind));
        self.taken[picture] = Some(row);
    }

    fn verbatim(&mut self, rows: &[&str], pictures: &[&str]) {
        let ids: HashMap<&str, usize> =
            pictures.iter().enumerate().map(|(index, id)| (*id, index)).collect();
        for (row, name) in rows.iter().enumerate() {
            if let Some(&picture) = ids.get(name) {
                self.assign(row, picture, MatchKind::Path);
            }
        }
    }

    /// Compares whole paths, without a number of leading folders of the rows or of the pictures.
    fn whole_paths(&mut self, of_rows: usize, of_pictures: usize, kind: MatchKind) {
        for transform in Transform::ALL {
            let pictures = keys(&self.pictures, of_pictures, |path| transform.key(path, false));
            let rows = keys(&self.rows, of_rows, |path| transform.key(path, true));
            for (key, rows) in rows {
                let Some(fitting) = pictures.get(&key) else { continue };
                match (rows.as_slice(), fitting.as_slice()) {
                    ([row], [picture]) => {
                        if self.found[*row].is_none() && self.taken[*picture].is_none() {
                            self.assign(*row, *picture, transform.kind(kind));
                        }
                    }
                    (rows, fitting) => self.note(rows, fitting),
                }
            }
        }
    }

    /// Compares paths of which one is the end of the other.
    fn ends(&mut self, transform: Transform) {
        let whole = keys(&self.pictures, 0, |path| transform.key(path, false));
        let mut by_end: HashMap<String, Vec<usize>> = HashMap::new();
        for (picture, path) in self.pictures.iter().enumerate() {
            for start in 0..path.len() {
                let key = transform.key(&path[start..], false);
                by_end.entry(key.unwrap_or_default()).or_default().push(picture);
            }
        }
        let names = |path: &[String]| path.last().cloned().unwrap_or_default();
        let mut rows_of_name: HashMap<Option<String>, usize> = HashMap::new();
        for path in &self.rows {
            *rows_of_name.entry(transform.key(&[names(path)], true)).or_default() += 1;
        }
        let mut claims: HashMap<usize, Vec<(usize, MatchKind)>> = HashMap::new();
        let mut unclear = Vec::new();
        for (row, path) in self.rows.iter().enumerate() {
            if self.found[row].is_some() {
                continue;
            }
            let full = transform.key(path, true).and_then(|key| by_end.get(&key));
            let shared_by = |start: usize| {
                let key = transform.key(&path[start..], true)?;
                Some((path.len() - start, whole.get(&key)?))
            };
            let fitting = match full {
                Some(fitting) => Some((path.len(), fitting)),
                None => (1..path.len()).find_map(shared_by),
            };
            let Some((shared, fitting)) = fitting else { continue };
            let name = transform.key(&[names(path)], true);
            let of_name = name.as_ref().and_then(|name| by_end.get(name));
            let is_unique = shared > 1
                || (of_name.is_some_and(|all| all.len() == 1)
                    && rows_of_name.get(&name) == Some(&1));
            match (fitting.as_slice(), is_unique) {
                ([picture], true) => {
                    let kind = if shared > 1 { MatchKind::Folder } else { MatchKind::BaseName };
                    claims.entry(*picture).or_default().push((row, transform.kind(kind)));
                }
                _ => {
                    let fitting = of_name.filter(|_| shared == 1).unwrap_or(fitting).clone();
                    unclear.push((row, fitting));
                }
            }
        }
        for (row, fitting) in unclear {
            self.note(&[row], &fitting);
        }
        for (picture, rows) in claims {
            match (rows.as_slice(), self.taken[picture]) {
                ([(row, kind)], None) => self.assign(*row, picture, *kind),
                _ => {
                    let rows: Vec<usize> = rows.iter().map(|(row, _)| *row).collect();
                    self.note(&rows, &[picture]);
                }
            }
        }
    }

    fn note(&mut self, rows: &[usize], fitting: &[usize]) {
        for &row in rows {
            self.ambiguous[row].get_or_insert_with(|| fitting.to_vec());
        }
    }

    fn into_matches(self, pictures: &[&str]) -> Matches {
        let Self { found, ambiguous, taken, .. } = self;
        found
            .into_iter()
            .zip(ambiguous)
            .map(|(found, ambiguous)| {
                found.ok_or_else(|| match ambiguous.as_deref() {
                    None => "no picture has this name".to_owned(),
                    Some([picture]) if taken[*picture].is_some() => {
                        format!("the picture {} is that of another row", pictures[*picture])
                    }
                    Some([picture]) => {
                        format!("more than one row fits the picture {}", pictures[*picture])
                    }
                    Some(all) => {
                        let shown: Vec<&str> =
                            all.iter().take(3).map(|&index| pictures[index]).collect();
                        format!("it fits {} pictures, such as {}", all.len(), shown.join(", "))
                    }
                })
            })
            .collect()
    }
}

/// The indices of the paths with each key, without `skip` leading folders; paths with fewer are left out.
fn keys(
    paths: &[Vec<String>],
    skip: usize,
    key: impl Fn(&[String]) -> Option<String>,
) -> HashMap<String, Vec<usize>> {
    let mut keys: HashMap<String, Vec<usize>> = HashMap::new();
    for (index, path) in paths.iter().enumerate() {
        if let Some(key) = path.get(skip..).and_then(&key) {
            keys.entry(key).or_default().push(index);
        }
    }
    keys
}

#[cfg(test)]
mod tests;
