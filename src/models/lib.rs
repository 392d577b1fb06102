//! Installation of models: the catalogue, downloads, and the models folder.
//!
//! A model is installed if `ASSETS/models/NAME` holds its manifest and its ONNX file. That folder is created
//! atomically; unfinished files are kept in `ASSETS/models/.partial`. Which installed model is the default is decided
//! by [`whereabouts_vision::Assets::resolve`].

mod catalogue;
mod download;
mod install;
mod onnx;
mod partial;

pub use catalogue::{Catalogue, CatalogueError, Entry};
pub use download::{Download, DownloadError, DownloadSettings, Progress};
pub use install::{
    Added, Difference, InstallError, ModelsFolder, Pulled, Updated, VerifiedFiles, verify,
};
