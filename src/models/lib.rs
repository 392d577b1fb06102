//! Installing models: what can be had, how it is downloaded, where it is put.
//!
//! A model is installed when `ASSETS/models/NAME` holds its manifest and its ONNX file; that folder
//! appears whole or not at all. What is in the making lies in `ASSETS/models/.partial`. Which
//! installed model a server starts with is decided by [`whereabouts_vision::Assets::resolve`].

mod catalogue;
mod download;
mod install;
mod partial;

pub use catalogue::{Catalogue, CatalogueError, Entry};
pub use download::{Download, DownloadError, DownloadSettings, Progress};
pub use install::{Added, InstallError, ModelsFolder, Pulled, Verdict, verify};
