//! ONNX files with external weights, files that are something else, and hostile bytes.

use super::*;
use std::fs;

fn field(number: u64, contents: &[u8]) -> Vec<u8> {
    let mut bytes = varint(number << 3 | 2);
    bytes.extend(varint(contents.len() as u64));
    bytes.extend(contents);
    bytes
}

fn varint(mut value: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while value >= 0x80 {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
    bytes
}

fn entry(key: &str, value: &str) -> Vec<u8> {
    field(13, &[field(1, key.as_bytes()), field(2, value.as_bytes())].concat())
}

fn tensor(location: &str, offset: u64, length: u64) -> Vec<u8> {
    let (offset, length) = (offset.to_string(), length.to_string());
    let entries =
        [entry("location", location), entry("offset", &offset), entry("length", &length)].concat();
    [entries, vec![14 << 3, 1]].concat()
}

/// A model whose graph has these fields.
fn model(graph: &[u8]) -> Vec<u8> {
    [vec![1 << 3, 9], field(7, graph)].concat()
}

fn scan(bytes: &[u8]) -> Result<ExternalFiles, OnnxError> {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("model.onnx");
    fs::write(&file, bytes).unwrap();
    external_files(&file)
}

#[test]
fn weights_are_found_in_initializers_and_in_the_attributes_of_nodes() {
    let attribute = field(5, &tensor("deep/constants.bin", 0, 7));
    let inner = field(1, &field(5, &attribute));
    let branch = field(1, &field(5, &field(6, &inner)));
    let graph = [
        field(5, &tensor("model.onnx.data", 0, 100)),
        field(5, &tensor("model.onnx.data", 4096, 24)),
        field(5, &field(9, &[0; 1000])),
        branch,
    ];
    let found = scan(&model(&graph.concat())).unwrap();
    let expected = [("deep/constants.bin", 7), ("model.onnx.data", 4120)];
    let expected = expected.map(|(file, bytes)| (PathBuf::from(file), bytes));
    assert_eq!(found, ExternalFiles::from(expected));
}

#[test]
fn references_out_of_the_folder_are_rejected() {
    for location in ["../weights", "/etc/passwd", "a/../../b", "", "C:\\weights", "a\\..\\b"] {
        let error = scan(&model(&field(5, &tensor(location, 0, 1)))).unwrap_err();
        assert!(matches!(error, OnnxError::Location { .. }), "{location:?}: {error}");
    }
}

#[test]
fn other_files_are_named() {
    for (bytes, what) in [
        (b"".as_slice(), "empty"),
        (b"<!DOCTYPE html><html>", "HTML"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0", "LFS pointer"),
        (b"PK\x03\x04\0\0", "PyTorch checkpoint"),
        (b"\x80\x02\x8a\nl\xfc\x9c", "pickle"),
        (b"\x10\0\0\0\0\0\0\0{\"weights\"", "safetensors"),
        (b"Not Found", "text"),
        (b"{\"error\": \"gated\"}", "text"),
        (b"\0\0\0\0", "without a number"),
        (b"\x08\x09", "no graph"),
    ] {
        let error = scan(bytes).unwrap_err().to_string();
        assert!(error.contains(what), "{what}: {error}");
    }
}

#[test]
fn a_cut_file_says_how_much_is_missing() {
    let whole = model(&field(5, &field(9, &[7; 1000])));
    let error = scan(&whole[..whole.len() - 300]).unwrap_err();
    assert!(matches!(error, OnnxError::Cut { missing: 300, .. }), "{error}");
    for cut in 0..whole.len() {
        assert!(scan(&whole[..cut]).is_err(), "cut at {cut}");
    }
}

#[test]
fn deep_nesting_and_corrupt_bytes_end_in_an_error_or_a_result() {
    let mut graph = Vec::new();
    for _ in 0..100 {
        graph = field(1, &field(5, &field(6, &graph)));
    }
    assert!(matches!(scan(&model(&graph)), Err(OnnxError::Malformed { .. })));
    let whole = model(&field(5, &tensor("model.onnx.data", 1, 2)));
    for at in 0..whole.len() {
        for change in [0x01, 0x80, 0xFF] {
            let mut bytes = whole.clone();
            bytes[at] ^= change;
            let _ = scan(&bytes);
        }
    }
}
