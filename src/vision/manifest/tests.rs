//! Which manifests are valid, and what the digests of their descriptors cover.

use super::*;

const XFEAT: &str = include_str!("../../../deploy/models/xfeat.toml");

fn kind(name: &str) -> DescriptorKind {
    name.parse().unwrap()
}

fn parse(text: &str) -> Result<Manifest, ManifestError> {
    Manifest::parse(text, Path::new("manifest.toml"))
}

#[test]
fn the_built_in_manifest_is_consistent() {
    let manifest = parse(XFEAT).unwrap();
    assert_eq!(manifest.dimension(DescriptorKind::GEM), Some(576));
    assert_eq!(manifest.dimension(DescriptorKind::CLS), None);
    assert_eq!(manifest.dimension(kind("vlad")), Some(512));
    assert_eq!(manifest.default_kind(), kind("vlad"));
}

#[test]
fn a_contradiction_names_the_value() {
    for (from, to, named) in [
        ("dimension = 576", "dimension = 64", "dimension"),
        ("width = 320", "width = 321", "width"),
        ("file = \"model.onnx\"", "file = \"../model.onnx\"", "file"),
        ("[input]", "[data]\nfile = \"../weights\"\n[input]", "file"),
        ("[input]", "[data]\nfile = \"model.onnx\"\n[input]", "data.file"),
        ("gem_p = 3.0", "gem_p = 0.0", "gem_p"),
        ("cls = false", "cls = true", "CLS"),
        ("dimension = 512", "dimension = 4096", "descriptors.vlad.dimension"),
        ("block = 8", "block = 65", "descriptors.vlad.block"),
        ("sharpness = 30.0", "sharpness = 0.0", "descriptors.vlad.sharpness"),
        ("least_share = 0.05", "least_share = 0.0", "descriptors.vlad.least_share"),
        ("rows = 2", "rows = 0", "descriptors.vlad must have"),
        ("centres = 128", "centres = 0", "descriptors.vlad must have"),
        ("reliability = \"reliability\"\n", "", "output.reliability"),
        ("xfeat-vlad.bin", "model.onnx", "named once"),
        ("xfeat-vlad.bin", "../vlad.bin", "plain file name"),
        ("[descriptors.vlad]", "[descriptors.gem]", "another name"),
        ("[descriptors.vlad]", "[descriptors.VLAD]", "kind of descriptor"),
        ("method = \"vlad\"", "method = \"netvlad\"", "netvlad"),
        ("default_descriptor = \"vlad\"", "default_descriptor = \"cls\"", "default_descriptor"),
    ] {
        let error = parse(&XFEAT.replace(from, to)).unwrap_err().to_string();
        assert!(error.contains(named), "{to}: {error}");
    }
}

#[test]
fn the_digest_covers_exactly_what_determines_a_descriptor() {
    let file = Digest::of(b"weights");
    let digest = |from: &str, to: &str| {
        let text = XFEAT.replace(from, to);
        assert!(from.is_empty() || text != XFEAT, "{from}");
        parse(&text).unwrap().digest(&[file], DescriptorKind::GEM)
    };
    let plain = digest("", "");
    assert_eq!(digest("licence = \"Apache-2.0\"", "licence = \"other\""), plain);
    assert_ne!(digest("gem_p = 3.0", "gem_p = 4.0"), plain);
    assert_ne!(digest("width = 320", "width = 640"), plain);
    let others = [Digest::of(b"others")];
    assert_ne!(parse(XFEAT).unwrap().digest(&others, DescriptorKind::GEM), plain);
}

#[test]
fn an_unknown_key_is_rejected() {
    assert!(parse(&format!("colour = 1\n{XFEAT}")).is_err());
}

/// Maps that were indexed before a manifest declared other kinds have this digest.
#[test]
fn the_digest_of_gem_does_not_depend_on_what_else_is_declared() {
    let manifest = parse(XFEAT).unwrap();
    let files: Vec<Digest> =
        manifest.files().map(|(_, pinned)| pinned.unwrap_or_else(|| Digest::of(b""))).collect();
    let digest = manifest.digest(&files, DescriptorKind::GEM).to_string();
    assert_eq!(digest, "sha256:bfac3884c9a2d3fb420f2e468b2dafcc9a4713fc3bcef4a1404c5df8f1fc3fd9");
}

#[test]
fn the_digest_of_vlad_covers_its_vocabulary_and_settings() {
    let digest = |text: &str, vocabulary: &[u8]| {
        let files = [Digest::of(b"weights"), Digest::of(vocabulary)];
        parse(text).unwrap().digest(&files, kind("vlad"))
    };
    let plain = digest(XFEAT, b"vocabulary");
    assert_ne!(digest(XFEAT, b"another"), plain);
    for (from, to) in [("sharpness = 30.0", "sharpness = 20.0"), ("width = 320", "width = 640")] {
        assert_ne!(digest(&XFEAT.replace(from, to), b"vocabulary"), plain, "{from}");
    }
    for (from, to) in [("xfeat-vlad.bin", "words.bin"), ("gem_p = 3.0", "gem_p = 4.0")] {
        assert_eq!(digest(&XFEAT.replace(from, to), b"vocabulary"), plain, "{from}");
    }
}

#[test]
fn a_manifest_declares_any_number_of_kinds_by_name() {
    let fourth =
        "\n[descriptors.whole]\nmethod = \"gem\"\ngem_p = 1.0\ngrid = [1, 1]\ndimension = 64\n";
    let text = XFEAT.replace("default_descriptor = \"vlad\"", "default_descriptor = \"whole\"");
    let manifest = parse(&format!("{text}{fourth}")).unwrap();
    assert_eq!(manifest.kinds(), ["gem", "vlad", "whole"].map(kind));
    assert_eq!(manifest.default_kind(), kind("whole"));
    assert_eq!(manifest.dimension(kind("whole")), Some(64));
    let files: Vec<_> = manifest.files().map(|(file, _)| file.to_owned()).collect();
    assert_eq!(files, ["model.onnx", "xfeat-vlad.bin"].map(Path::new));
    let mut pinned = manifest.clone();
    pinned.pin(&[Digest::of(b"a"), Digest::of(b"b")]);
    let read = parse(&pinned.to_toml().unwrap()).unwrap();
    let digests: Vec<_> = read.files().map(|(_, digest)| digest).collect();
    assert_eq!(digests, [Some(Digest::of(b"a")), Some(Digest::of(b"b"))]);
}
