#!/usr/bin/env bash
# Tests the operator console in a real browser: signs in, localizes a picture and follows its job,
# views jobs, maps and health, on a wide screen and on a phone, in light and dark.
#
#     check.sh BINARY VENV
#
# VENV is the folder of a Python virtual environment with playwright (requirements.txt); it is created if missing.
# The browser is chromium from the PATH, or the one in CHROMIUM. The reader must be installed (`make reader`). With SCREENSHOTS=FOLDER, screenshots of the
# views are written there. Takes about two minutes. Exits with 1 if anything fails.
set -euo pipefail
# shellcheck source-path=SCRIPTDIR source=../server.sh
. "$(dirname "$0")/../server.sh"
screenshots=
if [ -n "${SCREENSHOTS:-}" ]; then
    mkdir -p "$SCREENSHOTS"
    screenshots=$(realpath "$SCREENSHOTS")
fi
arguments "$0" "$@"
browser
environment "$venv" requirements.txt

# Serve the demo's own data folder: a map with images, and the jobs of its frames.
town "$binary" 12
mv "$scratch/town/data" "$scratch/data"
export WHEREABOUTS_MODEL__NAME=xfeat WHEREABOUTS_AUTH__KEYS=required
for role in admin robot; do
    "$binary" keys create --data "$scratch/data" --name "$role" --role "$role" --json > "$scratch/$role.json"
done
serve "$binary"
TOWN=$scratch/town URL=$url KEYS=$scratch CHROMIUM=$CHROMIUM SCREENSHOTS=$screenshots PYTHONDONTWRITEBYTECODE=1 \
    timeout 400 "$venv/bin/python" -m unittest
no_panic
