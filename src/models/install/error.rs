//! Why a model cannot be installed or verified, in words that say what to do.

use std::io;
use std::path::PathBuf;

use crate::download::DownloadError;
use crate::onnx::OnnxError;
use whereabouts_core::Digest;
use whereabouts_vision::{ManifestError, ModelFault};

/// Why a model cannot be installed or verified.
#[derive(Debug, thiserror::Error)]
pub enum InstallError {
    /// The name is not usable as a folder name.
    #[error(
        "{0:?} is not a valid model name: use up to 64 letters, digits, '-', '_' and '.', not \
         beginning with '.', and neither \"auto\" nor \"chosen\""
    )]
    Name(String),
    /// Another process is installing this model.
    #[error("another process is installing {name} ({lock} is locked); wait until it has ended")]
    Locked {
        /// Name of the model.
        name: String,
        /// Path of the lock file.
        lock: PathBuf,
    },
    /// The name is in use by another model.
    #[error(
        "another model is installed in {0}; give this one another name with --name, or remove \
         that folder"
    )]
    Taken(PathBuf),
    /// A file does not match the digest pinned in the manifest.
    #[error("{file} has the digest {got}, but its manifest pins {pinned}; {remedy}")]
    Damaged {
        /// Path of the file.
        file: PathBuf,
        /// Digest of the file.
        got: Digest,
        /// Pinned digest.
        pinned: Digest,
        /// What the user can do.
        remedy: String,
    },
    /// A folder was given as the ONNX file.
    #[error(
        "{0} is a folder; name the ONNX file in it, such as {example}",
        example = .0.join("model.onnx").display()
    )]
    Folder(PathBuf),
    /// The file is not a usable ONNX file.
    #[error(transparent)]
    Onnx(#[from] OnnxError),
    /// A file of external weights is missing or incomplete.
    #[error(
        "the model keeps weights in {file}, which {}; put that file next to the ONNX file, as it was exported",
        match bytes {
            None => "is missing".to_owned(),
            Some(bytes) => format!("has {bytes} bytes where at least {needed} are needed"),
        }
    )]
    Weights {
        /// Path of the file.
        file: PathBuf,
        /// Its size in bytes, if it exists.
        bytes: Option<u64>,
        /// The least size in bytes.
        needed: u64,
    },
    /// The installed model refers to a file that its manifest does not name.
    #[error("the model keeps weights in {0}, which its manifest does not name; install it again")]
    Unnamed(PathBuf),
    /// The model does not do what its manifest says.
    #[error(transparent)]
    Faulty(#[from] ModelFault),
    /// The manifest is invalid.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// The download failed.
    #[error(transparent)]
    Download(#[from] DownloadError),
    /// A file operation failed.
    #[error("cannot {doing} {path}: {source}")]
    Disk {
        /// The operation.
        doing: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// Cause.
        source: io::Error,
    },
}
