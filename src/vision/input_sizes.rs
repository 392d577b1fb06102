//! The sizes of pictures that settings ask for, in place of those of the manifests.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::manifest::{Manifest, ManifestError};

/// The size to which the pictures of some models are fitted, by name of the model. Written as a list of
/// `MODEL=WIDTHxHEIGHT`, or as a text of such entries with commas between them.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Entries", into = "Vec<String>")]
pub struct InputSizes(BTreeMap<String, [u32; 2]>);

#[derive(Deserialize)]
#[serde(untagged, expecting = "a list of MODEL=WIDTHxHEIGHT")]
enum Entries {
    Text(String),
    List(Vec<String>),
}

impl TryFrom<Entries> for InputSizes {
    type Error = String;

    fn try_from(entries: Entries) -> Result<Self, String> {
        match entries {
            Entries::Text(text) if text.trim().is_empty() => Ok(Self::default()),
            Entries::Text(text) => {
                text.split(',').map(str::to_owned).collect::<Vec<_>>().try_into()
            }
            Entries::List(list) => list.try_into(),
        }
    }
}

impl InputSizes {
    /// The models that have one.
    pub fn models(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }

    /// Changes the manifest of a model that has one. An error if the model cannot take that size.
    pub(super) fn apply(&self, mut manifest: Manifest) -> Result<Manifest, ManifestError> {
        let Some([width, height]) = self.0.get(&manifest.name) else { return Ok(manifest) };
        (manifest.input.width, manifest.input.height) = (*width, *height);
        match manifest.fault() {
            None => Ok(manifest),
            Some(detail) => Err(ManifestError::Size {
                setting: entry(&manifest.name, [*width, *height]),
                detail,
            }),
        }
    }
}

fn entry(model: &str, [width, height]: [u32; 2]) -> String {
    format!("{model}={width}x{height}")
}

impl TryFrom<Vec<String>> for InputSizes {
    type Error = String;

    fn try_from(entries: Vec<String>) -> Result<Self, String> {
        let mut sizes = BTreeMap::new();
        for entry in entries {
            let (model, size) = parse(&entry).ok_or_else(|| {
                format!("{entry:?} is not MODEL=WIDTHxHEIGHT, such as \"dinov2-small=322x322\"")
            })?;
            if sizes.insert(model.to_owned(), size).is_some() {
                return Err(format!("the model {model:?} has two sizes; leave one out"));
            }
        }
        Ok(Self(sizes))
    }
}

fn parse(entry: &str) -> Option<(&str, [u32; 2])> {
    let (model, size) = entry.split_once('=')?;
    let (width, height) = size.trim().split_once(['x', '×'])?;
    let model = Some(model.trim()).filter(|model| !model.is_empty())?;
    Some((model, [width.trim().parse().ok()?, height.trim().parse().ok()?]))
}

impl From<InputSizes> for Vec<String> {
    fn from(sizes: InputSizes) -> Self {
        sizes.0.iter().map(|(model, size)| entry(model, *size)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sizes(entries: &[&str]) -> Result<InputSizes, String> {
        InputSizes::try_from(entries.iter().map(|entry| (*entry).to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn sizes_are_read_and_written_as_a_list() {
        let read = sizes(&["dinov2-small=518x518", " other = 448×322"]).unwrap();
        assert_eq!(read.models().collect::<Vec<_>>(), ["dinov2-small", "other"]);
        let written: Vec<String> = read.clone().into();
        assert_eq!(written, ["dinov2-small=518x518", "other=448x322"]);
        assert_eq!(InputSizes::try_from(written), Ok(read));
    }

    #[test]
    fn a_text_is_read_as_a_list() {
        #[derive(Deserialize)]
        struct Section {
            sizes: InputSizes,
        }
        let read = |text: &str| toml::from_str::<Section>(text).map(|section| section.sizes);
        let list = read("sizes = [\"a=14x28\", \"b=42x42\"]").unwrap();
        assert_eq!(read("sizes = \"a=14x28, b=42x42\"").unwrap(), list);
        assert_eq!(read("sizes = \"\"").unwrap(), InputSizes::default());
        assert!(read("sizes = 518").unwrap_err().to_string().contains("MODEL=WIDTHxHEIGHT"));
    }

    #[test]
    fn an_entry_that_is_no_size_says_what_one_is() {
        for wrong in
            ["dinov2-small", "518x518", "=518x518", "m=518", "m=x518", "m=-1x2", "m=1x2x3", ""]
        {
            let why = sizes(&[wrong]).unwrap_err();
            assert!(why.contains("MODEL=WIDTHxHEIGHT"), "{why}");
        }
        assert!(sizes(&["m=14x14", "m=28x28"]).unwrap_err().contains("two sizes"));
    }
}
