#!/usr/bin/env bash
# Installs the peers of the benchmarks into a virtual environment, once, and prints the path of its Python.
#
# usage: PYTHON=$(benches/peers/setup.sh) cargo bench …
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
dest=$here/../../target/peers
wanted=$(cat "$here/requirements.txt")
if [ "$(cat "$dest/.installed" 2>/dev/null)" != "$wanted" ]; then
    echo 'installing the peers of the benchmarks: several gigabytes, mostly PyTorch' >&2
    "${PYTHON:-python3}" -m venv "$dest" || {
        echo 'Python cannot create a virtual environment: apt-get install python3-venv' >&2
        exit 1
    }
    "$dest/bin/pip" install --quiet --requirement "$here/requirements.txt" >&2
    printf '%s\n' "$wanted" >"$dest/.installed"
fi
echo "$dest/bin/python"
