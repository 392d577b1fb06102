#!/usr/bin/env bash
# Runs a command with a server of its own that speaks S3, which is gone afterwards:
#
#     tests/s3.sh VENV COMMAND [ARGUMENT...]
#
# VENV is made if it is not there, and the server put into it. The command finds the address in
# WHEREABOUTS_TEST_S3, and there the bucket whereabouts-test; if that is set already, that server is used.
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
# The bucket is there once the server is.
"$venv/bin/python" - "$url/whereabouts-test" <<'PYTHON' || { cat "$log" >&2; exit 1; }
import sys, time, urllib.request

deadline = time.monotonic() + 60
while True:
    try:
        urllib.request.urlopen(urllib.request.Request(sys.argv[1], method="PUT"), timeout=5)
        break
    except OSError as error:
        if time.monotonic() > deadline:
            sys.exit(f"the server that speaks S3 did not start: {error}")
        time.sleep(0.1)
PYTHON

export WHEREABOUTS_TEST_S3="$url"
"$@"
