#!/usr/bin/env bash
# Checks the server against the contract in proto/ with an independent gRPC client, which learns the contract only
# through reflection; and lints the contract with buf.
#
#     check.sh BINARY VENV
#
# VENV is the folder of a Python virtual environment with grpcio (requirements.txt); it is created if missing. After
# that, a run takes about half a minute. Exits with 1 if anything fails.
set -euo pipefail
# shellcheck source-path=SCRIPTDIR source=../server.sh
. "$(dirname "$0")/../server.sh"
arguments "$0" "$@"
environment "$venv" requirements.txt
(cd ../../proto && "$venv/bin/buf" lint)

town "$binary" 12
export WHEREABOUTS_MODEL__NAME=xfeat WHEREABOUTS_SERVER__BODY_LIMIT_BYTES=2000000
export WHEREABOUTS_SERVER__BODIES_LIMIT_BYTES=80000000
export WHEREABOUTS_SERVER__BODY_PAUSE_S=2 WHEREABOUTS_SERVER__STREAM_IDLE_S=4
export WHEREABOUTS_AUTH__KEYS=required
"$binary" keys create --data "$scratch/data" --name test --role admin --json > "$scratch/key.json"
serve "$binary"
# HTTP/2 without TLS.
version=$(curl --silent --fail --http2-prior-knowledge --output /dev/null --write-out '%{http_version}' "$url/livez")
if [ "$version" != 2 ]; then
    echo "GET /livez was answered over HTTP/$version" >&2
    exit 1
fi
BINARY=$binary TOWN=$scratch/town URL=$url KEY=$scratch/key.json SERVER=$server PYTHONDONTWRITEBYTECODE=1 \
    timeout 240 "$venv/bin/python" -m unittest
server=
no_panic
