#!/usr/bin/env bash
# Packs what a user of a release needs into FOLDER/whereabouts-VERSION-TARGET.tar.gz, with its SHA-256 in a file of the
# same name plus .sha256: the binary, ONNX Runtime and the built-in model (assets/), licences, README and changelog. The
# binary finds assets/ next to itself.
#
#     package.sh BINARY FOLDER
set -euo pipefail

if [ $# -ne 2 ]; then
    echo "usage: $0 BINARY FOLDER, such as: $0 target/release/whereabouts target" >&2
    exit 2
fi
binary=$(realpath "$1")
folder=$(realpath "$2")
cd "$(dirname "$0")/../.."

version=$("$binary" --version)
name=whereabouts-${version#* }-$(rustc -vV | sed -n 's/^host: //p')
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
mkdir -p "$scratch/$name/assets/models"
cp LICENSE README.md CHANGELOG.md "$scratch/$name"
# Not other models or libraries that were installed here.
cp -RL assets/onnxruntime "$scratch/$name/assets"
cp -RL assets/models/xfeat "$scratch/$name/assets/models"
install -m 0755 "$binary" "$scratch/$name/whereabouts"
tar -C "$scratch" -czf "$folder/$name.tar.gz" "$name"
(
    cd "$folder"
    if command -v sha256sum > /dev/null; then sha256sum "$name.tar.gz"; else shasum -a 256 "$name.tar.gz"; fi
) > "$folder/$name.tar.gz.sha256"
echo "$folder/$name.tar.gz"
