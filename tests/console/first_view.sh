#!/usr/bin/env bash
# Measures the size and load time of the operator console: fills a temporary server with 10,000 jobs and 5,000 images
# and opens views in a browser with an empty cache.
#
#     first_view.sh BINARY VENV
#
# VENV and the browser are those of check.sh. Takes several minutes, mostly to fill the server. Exits with 1
# if the first view is above 200 kB or 300 ms.
set -euo pipefail
# shellcheck source-path=SCRIPTDIR source=../server.sh
. "$(dirname "$0")/../server.sh"
arguments "$0" "$@"
browser
environment "$venv" requirements.txt

town "$binary" 12
export WHEREABOUTS_MODEL__NAME=xfeat WHEREABOUTS_JOBS__QUEUE=20000
serve "$binary"
TOWN=$scratch/town URL=$url CHROMIUM=$CHROMIUM PYTHONDONTWRITEBYTECODE=1 "$venv/bin/python" first_view.py
