#!/usr/bin/env bash
# Holds the server against its own description with schemathesis: no status that is not described, no answer
# of another shape, no server error. Requests are made up from the description, right ones and wrong ones.
#
#     conformance.sh BINARY VENV [EXAMPLES]
#
# VENV is a folder for a Python environment with schemathesis (requirements.txt); it is made if it is not
# there. EXAMPLES is how many requests are made up for each call, beside those that cover its parameters one
# by one; 5 unless told otherwise. Ends with 1 if anything is not as described.
set -euo pipefail

if [ $# -lt 2 ] || [ $# -gt 3 ]; then
    echo "usage: $0 BINARY VENV [EXAMPLES], such as: $0 target/release/whereabouts target/api-venv" >&2
    exit 2
fi
binary=$(realpath "$1")
venv=$(realpath -m "$2")
examples=${3:-5}
cd "$(dirname "$0")"

# shellcheck source-path=SCRIPTDIR source=../server.sh
. ../server.sh
environment "$venv" requirements.txt
export WHEREABOUTS_MODEL__NAME=xfeat
serve "$binary"
curl --silent --fail --output /dev/null -X PUT "$url/maps/town" -H 'Content-Type: application/json' \
    -d '{"scene": "outdoor"}'

# The stream of all jobs has no end. One worker: Python before 3.11.5 breaks off now and then when two threads
# parse Python, as schemathesis does.
(cd "$scratch" && "$venv/bin/schemathesis" --config-file "$OLDPWD/schemathesis.toml" run "$url/openapi.json" \
    --exclude-path /events --max-examples "$examples" --seed 1 --workers 1 --phases examples,coverage,fuzzing \
    --checks not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance \
    --continue-on-failure --no-shrink --warnings off --request-timeout 60)
if grep -q panicked "$scratch/log"; then
    grep panicked "$scratch/log" >&2
    exit 1
fi
