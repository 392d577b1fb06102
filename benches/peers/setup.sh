#!/usr/bin/env bash
# Gets the peers of the benchmarks into a virtual environment, once, and prints its Python.
#
# usage: PYTHON=$(benches/peers/setup.sh) cargo bench …
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
dest=$here/../../target/peers
wanted=$(cat "$here/requirements.txt")
if [ "$(cat "$dest/.installed" 2>/dev/null)" != "$wanted" ]; then
    echo 'getting the peers of the benchmarks: some gigabytes, most of them PyTorch' >&2
    "${PYTHON:-python3}" -m venv "$dest" || {
        echo 'Python cannot make a virtual environment: apt-get install python3-venv' >&2
        exit 1
    }
    "$dest/bin/pip" install --quiet --requirement "$here/requirements.txt" >&2
    printf '%s\n' "$wanted" >"$dest/.installed"
fi
echo "$dest/bin/python"
