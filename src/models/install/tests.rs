//! Adding, verifying and locking models in a temporary folder.

use super::*;

/// The assets of the checkout, which has ONNX Runtime.
fn runtime() -> Assets {
    Assets::locate(None)
}

fn fixture(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/fixtures/models/tiny-tokens").join(file)
}

#[test]
fn an_added_file_is_pinned_and_found() {
    let assets = tempfile::tempdir().unwrap();
    let folder = ModelsFolder::open(assets.path()).unwrap();
    let add = |name| folder.add(&runtime(), &fixture("model.onnx"), &fixture(MANIFEST), name);
    let Added::Installed { folder: placed, digests, .. } = add(Some("mine")).unwrap() else {
        panic!("it was not there before");
    };
    let verified = verify(&placed).unwrap();
    assert_eq!(verified.digests, digests);
    assert_eq!(verified.manifest.sha256, digests.first().copied());
    assert_eq!(verified.manifest.name, "mine");
    assert_eq!(Assets::locate(Some(assets.path())).model("mine").unwrap(), placed);
    assert!(matches!(add(Some("mine")).unwrap(), Added::Present(_)));
    assert!(matches!(add(Some("../mine")), Err(InstallError::Name(_))));
    assert!(matches!(add(Some("auto")), Err(InstallError::Name(_))));
}

#[test]
fn a_taken_name_and_a_wrong_file_are_rejected() {
    let assets = tempfile::tempdir().unwrap();
    let folder = ModelsFolder::open(assets.path()).unwrap();
    folder.add(&runtime(), &fixture("model.onnx"), &fixture(MANIFEST), None).unwrap();
    let other = assets.path().join("other.onnx");
    // The same graph with a comment.
    let comment = b"\x32\x05other";
    fs::write(&other, [&fs::read(fixture("model.onnx")).unwrap()[..], comment].concat()).unwrap();
    let wrong = folder.add(&runtime(), &other, &fixture(MANIFEST), None).unwrap_err().to_string();
    assert!(wrong.contains("pins"), "{wrong}");
    let manifest = assets.path().join("other.toml");
    let text = fs::read_to_string(fixture(MANIFEST)).unwrap();
    let unpinned: Vec<_> = text.lines().filter(|line| !line.starts_with("sha256")).collect();
    fs::write(&manifest, unpinned.join("\n")).unwrap();
    assert!(matches!(folder.add(&runtime(), &other, &manifest, None), Err(InstallError::Taken(_))));
}

#[test]
fn external_weights_are_installed_and_verified() {
    let (assets, given) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let folder = ModelsFolder::open(assets.path()).unwrap();
    let (file, manifest) = (given.path().join("model.onnx"), given.path().join("given.toml"));
    fs::copy(fixture("model.onnx"), &file).unwrap();
    let text = fs::read_to_string(fixture(MANIFEST)).unwrap();
    let data = "[data]\nfile = \"model.onnx.data\"\n[input]";
    fs::write(&manifest, text.replace("[input]", data)).unwrap();
    let missing = folder.add(&runtime(), &file, &manifest, None).unwrap_err().to_string();
    assert!(missing.contains("model.onnx.data"), "{missing}");

    fs::write(given.path().join("model.onnx.data"), "weights").unwrap();
    let Added::Installed { folder: placed, digests, .. } =
        folder.add(&runtime(), &file, &manifest, None).unwrap()
    else {
        panic!("it was not there before");
    };
    assert_eq!(digests[1], Digest::of(b"weights"));
    assert_eq!(verify(&placed).unwrap().digests, digests);
    fs::write(placed.join("model.onnx.data"), "weight5").unwrap();
    assert!(matches!(verify(&placed), Err(InstallError::Damaged { .. })));
    fs::write(given.path().join("model.onnx.data"), "others").unwrap();
    assert!(matches!(folder.add(&runtime(), &file, &manifest, None), Err(InstallError::Taken(_))));
}

#[test]
fn a_model_is_installed_by_one_process_at_a_time() {
    let assets = tempfile::tempdir().unwrap();
    let folder = ModelsFolder::open(assets.path()).unwrap();
    let held = folder.lock("m").unwrap();
    assert!(matches!(folder.lock("m"), Err(InstallError::Locked { .. })));
    assert!(folder.lock("n").is_ok());
    drop(held);
    assert!(folder.lock("m").is_ok());
}

/// The names in the folder of what is being installed.
fn partial(assets: &tempfile::TempDir) -> Vec<String> {
    let entries = fs::read_dir(assets.path().join("models/.partial")).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

#[test]
fn an_installation_leaves_nothing_behind_whether_it_succeeds_or_not() {
    let assets = tempfile::tempdir().unwrap();
    let folder = ModelsFolder::open(assets.path()).unwrap();
    let given = tempfile::tempdir().unwrap();
    let manifest = fixture(MANIFEST);
    let refused = folder.add(&runtime(), given.path(), &manifest, None).unwrap_err().to_string();
    assert!(refused.contains("is a folder; name the ONNX file"), "{refused}");
    assert!(partial(&assets).is_empty(), "{:?}", partial(&assets));
    // A graph that cannot be run, of the digest that the manifest pins.
    let (file, other) = (given.path().join("model.onnx"), given.path().join("other.toml"));
    let mut bytes = fs::read(fixture("model.onnx")).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle..].reverse();
    fs::write(&file, bytes).unwrap();
    let text = fs::read_to_string(&manifest).unwrap();
    let unpinned: Vec<_> = text.lines().filter(|line| !line.starts_with("sha256")).collect();
    fs::write(&other, unpinned.join("\n")).unwrap();
    folder.add(&runtime(), &file, &other, None).unwrap_err();
    assert!(partial(&assets).is_empty(), "{:?}", partial(&assets));
    folder.add(&runtime(), &fixture("model.onnx"), &manifest, None).unwrap();
    assert!(partial(&assets).is_empty(), "{:?}", partial(&assets));
}
