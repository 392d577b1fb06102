//! A look into an ONNX file without loading it: whether it is one, whether it is whole, and which files of external
//! weights it refers to.
//!
//! Reads the protocol buffer field by field and skips the weights, so that a file of gigabytes costs no memory.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek};
use std::path::{Component, Path, PathBuf};

/// Nesting of messages that is followed: graphs within the attributes of nodes within graphs.
const MAX_DEPTH: u32 = 32;

/// Files of external weights that a model may have. Old exporters write one for each tensor.
const MAX_FILES: usize = 4096;

/// Longest name of such a file, in bytes.
const MAX_NAME: u64 = 1024;

/// Files of external weights, relative to the ONNX file, and the least number of bytes of each.
pub type ExternalFiles = BTreeMap<PathBuf, u64>;

/// Why a file is not a usable ONNX file.
#[derive(Debug, thiserror::Error)]
pub enum OnnxError {
    /// The file cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Cause.
        source: io::Error,
    },
    /// The file is something else.
    #[error("{path} is not an ONNX file but {what}; {remedy}")]
    Foreign {
        /// The file.
        path: PathBuf,
        /// What the file is.
        what: &'static str,
        /// What the user can do.
        remedy: &'static str,
    },
    /// The file is incomplete.
    #[error("{path} is incomplete: it ends {missing} bytes early; download or export it again")]
    Cut {
        /// The file.
        path: PathBuf,
        /// Bytes that are missing, at least.
        missing: u64,
    },
    /// The file is not a valid ONNX file.
    #[error("{path} is not an ONNX file: {detail}; check where it comes from")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
    /// A reference to external weights leads out of the folder of the model.
    #[error(
        "{path} keeps weights in {location:?}, which is not a file next to it; export the model again, for example \
         with `onnx.save_model(model, file, save_as_external_data=True, location=\"model.onnx.data\")`"
    )]
    Location {
        /// The file.
        path: PathBuf,
        /// The reference.
        location: String,
    },
}

/// Finds the files of external weights that an ONNX file refers to.
pub fn external_files(path: &Path) -> Result<ExternalFiles, OnnxError> {
    let failed = |source| OnnxError::Read { path: path.to_owned(), source };
    let file = File::open(path).map_err(failed)?;
    let length = file.metadata().map_err(failed)?.len();
    let mut head = [0; 64];
    let mut reader = BufReader::with_capacity(1 << 16, file);
    let read = read_up_to(&mut reader, &mut head).map_err(failed)?;
    if let Some((what, remedy)) = foreign(&head[..read]) {
        return Err(OnnxError::Foreign { path: path.to_owned(), what, remedy });
    }
    reader.rewind().map_err(failed)?;
    let mut scan = Scan { reader, at: 0, length, has_graph: false, found: ExternalFiles::new() };
    match scan.message(length, Message::Model, 0) {
        Ok(()) if scan.has_graph => Ok(scan.found),
        Ok(()) => {
            let detail = "it holds no graph".to_owned();
            Err(OnnxError::Malformed { path: path.to_owned(), detail })
        }
        Err(fault) => Err(match fault {
            Fault::Read(source) => failed(source),
            Fault::Cut(missing) => OnnxError::Cut { path: path.to_owned(), missing },
            Fault::Malformed(detail) => OnnxError::Malformed { path: path.to_owned(), detail },
            Fault::Location(location) => OnnxError::Location { path: path.to_owned(), location },
        }),
    }
}

/// Recognises what people take for an ONNX file.
fn foreign(head: &[u8]) -> Option<(&'static str, &'static str)> {
    let text = head.trim_ascii_start();
    let starts = |word: &[u8]| text.get(..word.len()).is_some_and(|t| t.eq_ignore_ascii_case(word));
    if head.is_empty() {
        Some(("empty", "download or export it again"))
    } else if starts(b"<!doctype") || starts(b"<html") || starts(b"<?xml") {
        Some((
            "an HTML or XML page, probably an error or a login page of the hub",
            "download the file itself: its address on a hub contains /resolve/, not /blob/",
        ))
    } else if starts(b"version https://git-lfs") {
        Some(("a Git LFS pointer", "run `git lfs pull` where it was cloned, or download the file"))
    } else if head.starts_with(b"PK\x03\x04") {
        Some((
            "a ZIP archive or a PyTorch checkpoint",
            "unpack it, or export the model with `torch.onnx.export`",
        ))
    } else if head.starts_with(b"\x80\x02") {
        Some(("a Python pickle", "export the model with `torch.onnx.export`"))
    } else if head.starts_with(b"\x1F\x8B") || head.starts_with(b"\x28\xB5\x2F\xFD") {
        Some(("a compressed file", "unpack it first"))
    } else if head.get(8) == Some(&b'{') && head.get(2..8) == Some(&[0; 6]) {
        Some((
            "a safetensors file of weights",
            "export the model to ONNX, for example with `optimum-cli`",
        ))
    } else if head.starts_with(b"GGUF") || head.get(4..8) == Some(b"TFL3") {
        Some(("a model of another runtime", "export it to ONNX"))
    } else if starts(b"{")
        || head.iter().all(|byte| (0x20..0x7F).contains(byte) || b"\r\n\t".contains(byte))
    {
        Some(("a text file", "pass the .onnx file, and the manifest with --manifest"))
    } else {
        None
    }
}

/// A message of onnx.proto that is looked into.
#[derive(Clone, Copy)]
enum Message {
    Model,
    Graph,
    Function,
    Node,
    Attribute,
    Tensor,
    SparseTensor,
}

impl Message {
    /// The message in a field, by the numbers of onnx.proto.
    fn field(self, number: u64) -> Option<Self> {
        match (self, number) {
            (Self::Model, 7) | (Self::Attribute, 6 | 11) => Some(Self::Graph),
            (Self::Model, 25) => Some(Self::Function),
            (Self::Graph, 1) | (Self::Function, 7) => Some(Self::Node),
            (Self::Node, 5) | (Self::Function, 11) => Some(Self::Attribute),
            (Self::Graph, 5) | (Self::Attribute, 5 | 10) | (Self::SparseTensor, 1 | 2) => {
                Some(Self::Tensor)
            }
            (Self::Graph, 15) | (Self::Attribute, 22 | 23) => Some(Self::SparseTensor),
            _ => None,
        }
    }
}

enum Fault {
    Read(io::Error),
    Cut(u64),
    Malformed(String),
    Location(String),
}

impl From<io::Error> for Fault {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::UnexpectedEof => Self::Cut(1),
            _ => Self::Read(error),
        }
    }
}

struct Scan<R> {
    reader: R,
    /// Position in the file.
    at: u64,
    /// Size of the file.
    length: u64,
    has_graph: bool,
    found: ExternalFiles,
}

/// Where the weights of a tensor are.
#[derive(Default)]
struct External {
    location: Option<String>,
    offset: u64,
    length: u64,
}

impl Scan<BufReader<File>> {
    /// Reads a message that ends at `end`.
    fn message(&mut self, end: u64, message: Message, depth: u32) -> Result<(), Fault> {
        if depth > MAX_DEPTH {
            return Err(Fault::Malformed("its graphs are nested too deeply".into()));
        }
        let mut external = External::default();
        while self.at < end {
            let Some((number, field_end)) = self.field(end)? else { continue };
            match message.field(number) {
                Some(inner) => {
                    self.has_graph |= matches!(message, Message::Model) && number == 7;
                    self.message(field_end, inner, depth + 1)?;
                }
                None if matches!(message, Message::Tensor) && number == 13 => {
                    self.entry(field_end, &mut external)?;
                }
                None => self.skip_to(field_end)?,
            }
        }
        external.location.map_or(Ok(()), |location| {
            self.refer(location, external.offset.saturating_add(external.length))
        })
    }

    /// Reads the key of a field. Returns its number and the end of its contents, or `None` after a number.
    fn field(&mut self, end: u64) -> Result<Option<(u64, u64)>, Fault> {
        let key = self.varint()?;
        if key >> 3 == 0 {
            return Err(Fault::Malformed("it has a field without a number".into()));
        }
        let field_end = match key & 7 {
            0 => {
                self.varint()?;
                return Ok(None);
            }
            1 => self.at.saturating_add(8),
            2 => self.varint()?.saturating_add(self.at),
            5 => self.at.saturating_add(4),
            kind => return Err(Fault::Malformed(format!("it has a field of kind {kind}"))),
        };
        if field_end > end {
            return Err(match field_end.checked_sub(self.length) {
                Some(missing) if missing > 0 => Fault::Cut(missing),
                _ => Fault::Malformed("a field is longer than what contains it".into()),
            });
        }
        match key & 7 {
            2 => Ok(Some((key >> 3, field_end))),
            _ => self.skip_to(field_end).map(|()| None),
        }
    }

    /// Reads a key and its value in the description of external weights.
    fn entry(&mut self, end: u64, external: &mut External) -> Result<(), Fault> {
        let (mut key, mut value) = (String::new(), String::new());
        while self.at < end {
            match self.field(end)? {
                Some((1, field_end)) => key = self.text(field_end)?,
                Some((2, field_end)) => value = self.text(field_end)?,
                Some((_, field_end)) => self.skip_to(field_end)?,
                None => {}
            }
        }
        let number = || {
            let malformed =
                || Fault::Malformed(format!("the {key} {value:?} of weights is no number"));
            value.parse().map_err(|_| malformed())
        };
        match key.as_str() {
            "offset" => external.offset = number()?,
            "length" => external.length = number()?,
            "location" => external.location = Some(value),
            _ => {}
        }
        Ok(())
    }

    fn refer(&mut self, location: String, bytes: u64) -> Result<(), Fault> {
        let path = PathBuf::from(&location);
        let is_plain = |part: Component| matches!(part, Component::Normal(_));
        let is_inside = !location.is_empty() && path.components().all(is_plain);
        if !is_inside || location.contains(['\\', '\0', ':']) {
            return Err(Fault::Location(location));
        }
        let needed = self.found.entry(path).or_default();
        *needed = bytes.max(*needed);
        match self.found.len() > MAX_FILES {
            true => Err(Fault::Malformed(format!("it has more than {MAX_FILES} files of weights"))),
            false => Ok(()),
        }
    }

    fn text(&mut self, end: u64) -> Result<String, Fault> {
        let length = end - self.at;
        if length > MAX_NAME {
            return Err(Fault::Malformed("the name of a file of weights is too long".into()));
        }
        let mut bytes = vec![0; length as usize];
        self.reader.read_exact(&mut bytes)?;
        self.at = end;
        String::from_utf8(bytes)
            .map_err(|_| Fault::Malformed("the name of a file of weights is not UTF-8".into()))
    }

    fn skip_to(&mut self, end: u64) -> Result<(), Fault> {
        self.reader.seek_relative((end - self.at) as i64)?;
        self.at = end;
        Ok(())
    }

    fn varint(&mut self) -> Result<u64, Fault> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let mut byte = [0];
            self.reader.read_exact(&mut byte)?;
            self.at += 1;
            value |= u64::from(byte[0] & 0x7F) << shift;
            if byte[0] < 0x80 {
                return Ok(value);
            }
        }
        Err(Fault::Malformed("a number is too long".into()))
    }
}

fn read_up_to(reader: &mut impl Read, buffer: &mut [u8]) -> io::Result<usize> {
    let mut read = 0;
    while read < buffer.len() {
        match reader.read(&mut buffer[read..])? {
            0 => break,
            more => read += more,
        }
    }
    Ok(read)
}

#[cfg(test)]
mod tests;
