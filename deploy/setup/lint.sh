#!/usr/bin/env bash
# Installs the tools of `make lint` into a folder, pinned by version: typos (a wheel from PyPI) and cargo-deny (compiled
# once, without optimisation, because it runs for a second). Does nothing if these versions are there already.
#
#     lint.sh FOLDER
set -euo pipefail

typos=1.52.0
deny=0.20.2

if [ $# -ne 1 ]; then
    echo "usage: $0 FOLDER, such as: $0 target/lint" >&2
    exit 2
fi
tools=$1
if [ "$("$tools/bin/typos" --version 2> /dev/null)" != "typos-cli $typos" ]; then
    python3 -m venv "$tools"
    "$tools/bin/pip" install --quiet --disable-pip-version-check --only-binary=:all: "typos==$typos"
fi
if [ "$("$tools/bin/cargo-deny" --version 2> /dev/null)" != "cargo-deny $deny" ]; then
    "${CARGO:-cargo}" install --quiet --locked --debug --root "$tools" --version "$deny" cargo-deny
fi
