//! Reads a list of the correct references of each query, as CSV or JSON.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::Path;

use anyhow::{Context, anyhow, bail};
use serde::Deserialize;

use crate::poses::match_names;
use crate::table_file::{Table, plain};
use crate::{Folder, PictureFile};
use whereabouts_core::ImageId;

/// Names of the columns.
const QUERY: [&str; 5] = ["query", "queries", "queryimage", "image", "file"];
const REFERENCES: [&str; 8] =
    ["references", "reference", "positives", "matches", "match", "database", "correct", "truth"];

/// Most words of one name without quotes.
const MAX_WORDS: usize = 12;

/// A query and the names of its correct references.
struct Entry {
    /// Where it is in the file, for error messages.
    at: String,
    query: String,
    references: Vec<String>,
}

/// Reads the correct references of each query, in the order of the queries.
///
/// # Errors
/// The file cannot be read, or names an image that the folders do not have.
pub(super) fn read(
    file: &Path,
    database: &Folder,
    queries: &Folder,
) -> anyhow::Result<Vec<HashSet<ImageId>>> {
    let known: HashSet<&str> = ids(database).collect();
    let is_json = file.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("json"));
    let entries = if is_json { json(file)? } else { csv(file, &known)? };
    let query_of = resolve(entries.iter().map(|entry| entry.query.as_str()), queries);
    let reference_of = resolve(
        entries.iter().flat_map(|entry| entry.references.iter().map(String::as_str)),
        database,
    );
    let mut truth: HashMap<&ImageId, HashSet<ImageId>> = HashMap::new();
    for Entry { at, query, references } in &entries {
        let found = query_of
            .get(query.as_str())
            .ok_or_else(|| anyhow!("{at}: the folder of queries has no image {query:?}"))?;
        let truth = truth.entry(found).or_default();
        for name in references {
            let reference = reference_of.get(name.as_str()).ok_or_else(|| {
                anyhow!(
                    "{at}: the folder of references has no image {name:?}; quote names with spaces, or list them in \
                     JSON: [\"a b.jpg\", \"c.jpg\"]"
                )
            })?;
            truth.insert((*reference).clone());
        }
    }
    Ok(queries.pictures.iter().map(|query| truth.remove(&query.id).unwrap_or_default()).collect())
}

fn ids(folder: &Folder) -> impl Iterator<Item = &str> {
    folder.pictures.iter().map(|picture| picture.id.as_str())
}

/// Finds the image of each name.
fn resolve<'a, 'b>(
    names: impl Iterator<Item = &'a str>,
    folder: &'b Folder,
) -> HashMap<&'a str, &'b ImageId> {
    let by_id: HashMap<&str, &PictureFile> =
        folder.pictures.iter().map(|picture| (picture.id.as_str(), picture)).collect();
    let distinct: HashSet<&str> = names.collect();
    let (mut found, mut others) = (HashMap::new(), Vec::new());
    for name in distinct {
        match by_id.get(name) {
            Some(picture) => {
                found.insert(name, &picture.id);
            }
            None => others.push(name),
        }
    }
    others.sort_unstable();
    let images = match_names(&others, folder);
    found.extend(others.into_iter().zip(images).filter_map(|(name, image)| Some((name, image?))));
    found
}

fn json(file: &Path) -> anyhow::Result<Vec<Entry>> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Names {
        Many(Vec<String>),
        One(String),
    }
    #[derive(Deserialize)]
    struct Pair {
        query: String,
        #[serde(alias = "reference")]
        references: Names,
    }
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Listing {
        Map(BTreeMap<String, Names>),
        Pairs(Vec<Pair>),
    }
    let text = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
    let text = text.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(&text);
    let listing: Listing = serde_json::from_slice(text).map_err(|error| {
        anyhow!(
            "{} is not JSON of the form {{\"query.jpg\": [\"reference.jpg\"]}}: {error}",
            file.display()
        )
    })?;
    let pairs: Vec<(String, Names)> = match listing {
        Listing::Map(map) => map.into_iter().collect(),
        Listing::Pairs(pairs) => {
            pairs.into_iter().map(|pair| (pair.query, pair.references)).collect()
        }
    };
    let entry = |(query, names): (String, Names)| Entry {
        at: file.display().to_string(),
        query,
        references: match names {
            Names::Many(names) => names,
            Names::One(name) => vec![name],
        },
    };
    Ok(pairs.into_iter().map(entry).collect())
}

fn csv(file: &Path, known: &HashSet<&str>) -> anyhow::Result<Vec<Entry>> {
    let table = Table::read(file, |name| QUERY.contains(&name))?;
    let header: Vec<String> = table.header.iter().map(|name| plain(name)).collect();
    let column = |names: &[&str]| {
        names.iter().find_map(|name| header.iter().position(|column| column == name))
    };
    let (Some(query), Some(references)) = (column(&QUERY), column(&REFERENCES)) else {
        bail!("{} needs the columns query and references", file.display());
    };
    table
        .rows
        .iter()
        .map(|row| {
            let at = format!("{} line {}", file.display(), row.line);
            let names = names_in(&row.cells[references], known).with_context(|| at.clone())?;
            Ok(Entry { at, query: row.cells[query].clone(), references: names })
        })
        .collect()
}

/// Splits a cell into the names of references: a list in JSON, or names separated by spaces. Names that have
/// spaces themselves may be quoted; if they are not, there must be only one way to split the cell into names
/// that are known.
fn names_in(cell: &str, known: &HashSet<&str>) -> anyhow::Result<Vec<String>> {
    let cell = cell.trim();
    if cell.is_empty() {
        return Ok(Vec::new());
    }
    if known.contains(cell) {
        return Ok(vec![cell.to_owned()]);
    }
    if cell.starts_with('[') {
        let list = serde_json::from_str(cell);
        return list.with_context(|| format!("{cell:?} is not a list of names in JSON"));
    }
    let quoted = split_quoted(cell);
    if quoted.iter().all(|name| known.contains(name.as_str())) {
        return Ok(quoted);
    }
    for separator in [';', '|', ','] {
        let names: Vec<&str> =
            cell.split(separator).map(str::trim).filter(|name| !name.is_empty()).collect();
        if names.len() > 1 && names.iter().all(|name| known.contains(name)) {
            return Ok(names.into_iter().map(str::to_owned).collect());
        }
    }
    match segmented(cell, known)? {
        Some(names) => Ok(names),
        None => Ok(quoted),
    }
}

/// Splits at spaces outside of quotes.
fn split_quoted(cell: &str) -> Vec<String> {
    let (mut names, mut name, mut quote) = (Vec::new(), String::new(), None);
    for c in cell.chars() {
        match quote {
            Some(open) if c == open => quote = None,
            None if c == '"' => quote = Some(c),
            None if c.is_whitespace() => names.push(std::mem::take(&mut name)),
            _ => name.push(c),
        }
    }
    names.push(name);
    names.retain(|name| !name.is_empty());
    names
}

/// Joins words to known names. `None` if that is not possible.
///
/// # Errors
/// It is possible in several ways.
fn segmented(cell: &str, known: &HashSet<&str>) -> anyhow::Result<Option<Vec<String>>> {
    let plain = cell.replace('"', " ");
    let mut words: Vec<(usize, usize)> = Vec::new();
    for word in plain.split_whitespace() {
        let start = words.last().map_or(0, |&(_, end)| end);
        let start = start + plain[start..].find(word).unwrap_or(0);
        words.push((start, start + word.len()));
    }
    // For each position between words, from the end: in how many ways the rest can be split (up to 2), and how
    // many words the next name has.
    let mut ways: Vec<(u8, usize)> = vec![(0, 0); words.len() + 1];
    ways[words.len()] = (1, 0);
    for first in (0..words.len()).rev() {
        for length in 1..=MAX_WORDS.min(words.len() - first) {
            let name = &plain[words[first].0..words[first + length - 1].1];
            let (after, _) = ways[first + length];
            if after > 0 && known.contains(name) {
                ways[first] = ((ways[first].0 + after).min(2), length);
            }
        }
    }
    match ways[0].0 {
        0 => return Ok(None),
        1 => {}
        _ => bail!(
            "{cell:?} can be split into names in several ways; quote them, or list them in JSON"
        ),
    }
    let (mut names, mut first) = (Vec::new(), 0);
    while first < words.len() {
        let length = ways[first].1.max(1);
        names.push(plain[words[first].0..words[first + length - 1].1].to_owned());
        first += length;
    }
    Ok(Some(names))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_is_split_into_names_however_they_are_written() {
        let known: HashSet<&str> = ["a b.jpg", "c.jpg", "d e f.jpg", "g'.jpg"].into();
        for (cell, names) in [
            ("", vec![]),
            ("c.jpg", vec!["c.jpg"]),
            ("a b.jpg", vec!["a b.jpg"]),
            ("c.jpg  g'.jpg", vec!["c.jpg", "g'.jpg"]),
            ("\"a b.jpg\" c.jpg", vec!["a b.jpg", "c.jpg"]),
            ("a b.jpg c.jpg d e f.jpg", vec!["a b.jpg", "c.jpg", "d e f.jpg"]),
            ("a b.jpg \"d e f.jpg\"", vec!["a b.jpg", "d e f.jpg"]),
            ("a b.jpg;c.jpg", vec!["a b.jpg", "c.jpg"]),
            ("a b.jpg | c.jpg", vec!["a b.jpg", "c.jpg"]),
            ("[\"a b.jpg\", \"c.jpg\"]", vec!["a b.jpg", "c.jpg"]),
            ("[]", vec![]),
            ("x.jpg c.jpg", vec!["x.jpg", "c.jpg"]),
        ] {
            assert_eq!(names_in(cell, &known).unwrap(), names, "{cell}");
        }
        assert!(names_in("[a b.jpg]", &known).is_err());
        let ambiguous: HashSet<&str> = ["a", "b.jpg", "a b.jpg", "c"].into();
        assert_eq!(names_in("a c", &ambiguous).unwrap(), ["a", "c"]);
        assert_eq!(
            names_in("a b.jpg c", &ambiguous).unwrap(),
            ["a", "b.jpg", "c"],
            "each word is a name"
        );
        let ways: HashSet<&str> = ["a b", "c", "a", "b c"].into();
        assert!(names_in("a b c", &ways).unwrap_err().to_string().contains("several ways"));
    }
}
