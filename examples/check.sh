#!/usr/bin/env bash
# Checks the examples and the load tests against a binary:
#
#     check.sh BINARY VENV
#
# VENV is the folder of a Python virtual environment with the tools (check-requirements.txt); it is created if
# missing. After that, a run takes about a minute. Exits with 1 if anything fails.
set -euo pipefail

if [ $# -ne 2 ]; then
    echo "usage: $0 BINARY VENV, such as: $0 target/release/whereabouts target/examples-venv" >&2
    exit 2
fi
if [ ! -x "$1" ]; then
    echo "$1 is not executable; \`make build\` builds target/release/whereabouts" >&2
    exit 2
fi
binary=$(realpath "$1")
venv=$(realpath -m "$2")
cd "$(dirname "$0")"
load=$(realpath ../tests/load)

step() {
    echo
    echo "== $*"
}

# shellcheck source-path=SCRIPTDIR source=../tests/server.sh
. ../tests/server.sh
if [ ! -e "$venv/complete" ]; then step "create a virtual environment with the tools in $venv"; fi
environment "$venv" python/requirements.txt check-requirements.txt
export PATH=$venv/bin:$PATH PYTHONDONTWRITEBYTECODE=1

step ruff
ruff check --no-cache .
ruff check --no-cache --config ruff.toml ../tests/grpc ../tests/reading ../tests/wheel ../deploy/wheel

step "mypy --strict"
types=(mypy --strict --python-version 3.10 --cache-dir "$venv/mypy-cache")
(cd python && "${types[@]}" whereabouts_client.py index_and_localize.py test_client.py)
(cd ros2 && "${types[@]}" localizer.py test_localizer.py)
# The ROS packages have no type stubs here.
(cd ros2 && "${types[@]}" --ignore-missing-imports --allow-subclassing-any whereabouts_node.py)

step shellcheck
shellcheck -x ./*.sh "$load"/*.sh ../tests/*.sh ../tests/api/*.sh ../tests/grpc/*.sh ../tests/console/*.sh ../tests/deploy/*.sh ../tests/reading/*.sh ../tests/wheel/*.sh ../deploy/wheel/*.sh

step "tests of the ROS 2 localizer"
(cd ros2 && timeout 60 python -m unittest)

step "tests of the Python client"
(cd python && WHEREABOUTS_BIN=$binary timeout 120 python -m unittest)

step "index and localize a small town"
if ! "$binary" demo --offline --json --places 6 --out "$scratch/town" > "$scratch/log" 2>&1; then
    cat "$scratch/log" >&2
    exit 1
fi
serve "$binary"
(cd python && python index_and_localize.py --server "$url" --map town "$scratch/town/map" "$scratch/town/frames")

step curl.sh
./curl.sh "$url" "$scratch/town/frames" > "$scratch/curl" || { cat "$scratch/curl" >&2; exit 1; }
tail -n 1 "$scratch/curl"

step localize.sh
"$load/localize.sh" "$url" town "$scratch/town/frames" 2 20

step jobs.sh
"$load/jobs.sh" "$url" town "$scratch/town/frames" 2 10

step "all checks passed"
