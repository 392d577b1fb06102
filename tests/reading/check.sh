#!/usr/bin/env bash
# Compares the reader of scene text with rapidocr, another implementation of the same models:
#
#     check.sh BINARY VENV
#
# VENV is the folder of a Python virtual environment with the peer (requirements.txt); it is created if missing. The
# reader must be installed (`make reader`). Exits with 1 if anything fails.
set -euo pipefail

# shellcheck source-path=SCRIPTDIR source=../server.sh
. "$(dirname "$0")/../server.sh"
arguments "$0" "$@"
environment "$venv" requirements.txt
"$venv/bin/python" test_reading.py "$binary" ../../assets/models/ppocrv5
