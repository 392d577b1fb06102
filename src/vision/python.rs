//! What `pip install whereabouts-vpr` puts beside the binary: the built-in model in the package `whereabouts`, and ONNX
//! Runtime in the package `onnxruntime`, which it depends on.

use std::fs;
use std::path::{Path, PathBuf};

/// The package folders of the Python environment whose `bin` has the binary, if it is in one: a virtual environment, a
/// user's or a system's installation, or the target of `pip install --target`.
pub(super) fn package_folders(binary: &Path) -> Vec<PathBuf> {
    let Some(prefix) = binary.parent().and_then(Path::parent) else { return Vec::new() };
    let versions = entries(&prefix.join("lib"), |name| name.starts_with("python3"));
    let folders = versions.iter().flat_map(|version| {
        ["site-packages", "dist-packages"].map(|packages| version.join(packages))
    });
    folders.chain([prefix.to_owned()]).filter(|folder| assets(folder).is_dir()).collect()
}

/// The assets among these packages.
pub(super) fn assets(packages: &Path) -> PathBuf {
    packages.join("whereabouts").join("assets")
}

/// The ONNX Runtime among these packages. Its name ends with its version.
pub(super) fn onnxruntime(packages: &Path) -> Option<PathBuf> {
    let name = format!("{}onnxruntime.", std::env::consts::DLL_PREFIX);
    let folder = packages.join("onnxruntime").join("capi");
    let suffix = std::env::consts::DLL_SUFFIX;
    entries(&folder, |file| file.starts_with(&name) && file.contains(suffix)).pop()
}

/// The entries of a folder whose names are accepted, in the order of their names; none if it cannot be read.
fn entries(folder: &Path, accept: impl Fn(&str) -> bool) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> = entries
        .filter(|entry| entry.file_name().to_str().is_some_and(&accept))
        .map(|entry| entry.path())
        .collect();
    paths.sort();
    paths
}

#[cfg(test)]
mod tests {
    use super::*;

    fn touch(path: &Path) {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, "").unwrap();
    }

    #[test]
    fn an_installation_by_pip_is_found_from_its_binary() {
        for packages in ["lib/python3.12/site-packages", "lib/python3.11/dist-packages", ""] {
            let dir = tempfile::tempdir().unwrap();
            let packages = dir.path().join(packages);
            let library = format!(
                "onnxruntime/capi/{}onnxruntime{}",
                std::env::consts::DLL_PREFIX,
                if cfg!(target_os = "macos") { ".1.24.4.dylib" } else { ".so.1.24.4" }
            );
            touch(&packages.join("onnxruntime/capi/libonnxruntime_providers_shared.so"));
            touch(&packages.join(&library));
            assert_eq!(package_folders(&dir.path().join("bin/whereabouts")), Vec::<PathBuf>::new());
            fs::create_dir_all(assets(&packages)).unwrap();
            let found = package_folders(&dir.path().join("bin/whereabouts"));
            assert_eq!(found.len(), 1);
            assert_eq!(fs::canonicalize(&found[0]).unwrap(), fs::canonicalize(&packages).unwrap());
            assert_eq!(onnxruntime(&found[0]), Some(found[0].join(&library)));
        }
    }

    #[test]
    fn a_binary_elsewhere_has_no_packages() {
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir_all(dir.path().join("lib/python3.12/site-packages")).unwrap();
        assert!(package_folders(&dir.path().join("bin/whereabouts")).is_empty());
        assert!(package_folders(Path::new("/")).is_empty());
        assert_eq!(onnxruntime(dir.path()), None);
    }
}
