#!/usr/bin/env bash
# Runs a command with a temporary S3-compatible server, which is removed afterwards:
#
#     tests/s3.sh VENV COMMAND [ARGUMENT...]
#
# VENV is created if missing, and the server is installed into it. The command gets the URL in
# WHEREABOUTS_TEST_S3, with a bucket whereabouts-test; if that is already set, that server is used instead.
set -euo pipefail

[ $# -ge 2 ] || { sed -n '4,7s/^# \{0,1\}//p' "$0" >&2; exit 2; }
venv=$1
shift
if [ -n "${WHEREABOUTS_TEST_S3:-}" ]; then
    exec "$@"
fi

here=$(cd "$(dirname "$0")" && pwd)
# shellcheck source-path=SCRIPTDIR source=server.sh
. "$here/server.sh"
trap 'exit 130' INT TERM
environment "$venv" "$here/store/requirements.txt"
port=$(free_port "$venv")
log=$scratch/log

export AWS_ACCESS_KEY_ID=test AWS_SECRET_ACCESS_KEY=test
"$venv/bin/moto_server" -H 127.0.0.1 -p "$port" >"$log" 2>&1 &
server=$!
url=http://127.0.0.1:$port
# Create the bucket as soon as the server responds.
"$venv/bin/python" - "$url/whereabouts-test" <<'PYTHON' || { cat "$log" >&2; exit 1; }
import sys, time, urllib.request

deadline = time.monotonic() + 60
while True:
    try:
        urllib.request.urlopen(urllib.request.Request(sys.argv[1], method="PUT"), timeout=5)
        break
    except OSError as error:
        if time.monotonic() > deadline:
            sys.exit(f"the S3 server did not start: {error}")
        time.sleep(0.1)
PYTHON

export WHEREABOUTS_TEST_S3="$url"
"$@"
