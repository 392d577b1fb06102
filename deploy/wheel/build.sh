#!/usr/bin/env bash
# Builds the wheel `whereabouts-vpr` of this checkout, with the assets that `make assets` installed:
#
#     build.sh VENV FOLDER
#
# VENV is a Python virtual environment with maturin, which is created if it is missing. FOLDER gets the wheel, in place of
# those of earlier builds. maturin checks which glibc the binary needs and says so in the name of the wheel.
set -euo pipefail

if [ $# -ne 2 ]; then
    echo "usage: $0 VENV FOLDER, such as: $0 target/wheel-venv target/wheels" >&2
    exit 2
fi
venv=$(realpath -m "$1")
out=$(realpath -m "$2")
cd "$(dirname "$0")/../.."
model=assets/models/xfeat
if [ ! -f "$model/model.onnx" ]; then
    echo "$model is not installed: run \`make assets\`" >&2
    exit 1
fi
# shellcheck source-path=SCRIPTDIR source=../../tests/server.sh
. tests/server.sh
environment "$venv" deploy/wheel/requirements.txt

# As deep in the checkout as deploy/wheel, because pyproject.toml names the manifest of the crate by a relative path.
staged=target/wheel
rm -rf "$staged"
mkdir -p "$staged"
cp -r deploy/wheel/pyproject.toml deploy/wheel/README.md deploy/wheel/python LICENSE "$staged"
cp examples/python/whereabouts_client.py "$staged/python/whereabouts/client.py"
mkdir -p "$staged/python/whereabouts/assets/models"
cp -r "$model" "$staged/python/whereabouts/assets/models"
rm -rf "$out"
(cd "$staged" && "$venv/bin/maturin" build --release --out "$out")
