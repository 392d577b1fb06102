#!/usr/bin/env bash
# Installs the wheel into a fresh Python environment, as a newcomer does, and uses it from there, outside the checkout:
#
#     check.sh WHEELS VENV
#
# WHEELS is the folder that deploy/wheel/build.sh filled, VENV a folder for the environment, which is created again.
# Exits with 1 if anything fails.
set -euo pipefail

if [ $# -ne 2 ]; then
    echo "usage: $0 WHEELS VENV, such as: $0 target/wheels target/wheel-test-venv" >&2
    exit 2
fi
wheels=("$1"/whereabouts_vpr-*.whl)
if [ ${#wheels[@]} -ne 1 ] || [ ! -f "${wheels[0]}" ]; then
    echo "$1 does not have one wheel: run \`make wheel\`" >&2
    exit 2
fi
wheel=$(realpath "${wheels[0]}")
venv=$(realpath -m "$2")
here=$(realpath "$(dirname "$0")")
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
# What the developer's shell has set must not help.
unset ORT_DYLIB_PATH PYTHONPATH
for name in $(compgen -e WHEREABOUTS_ || true); do unset "$name"; done

echo "== install, and localize the first frame"
began=$(date +%s)
rm -rf "$venv"
python3 -m venv "$venv"
"$venv/bin/pip" install --quiet --disable-pip-version-check "$wheel"
cd "$scratch"
if ! "$venv/bin/whereabouts" demo --offline --json --places 6 --out town > report 2> log; then
    cat log >&2
    exit 1
fi
took=$(($(date +%s) - began))
echo "from pip install to the end of a demo: $took s"
# Downloads are not what is tested; without them it takes about 15 s.
if [ $took -gt 180 ]; then
    echo "that is too slow" >&2
    exit 1
fi

echo "== the client"
"$venv/bin/pip" install --quiet --disable-pip-version-check -r "$here/requirements.txt"
"$venv/bin/python" "$here/test_wheel.py" "$venv/bin/whereabouts" "$scratch/town"

echo "== mypy --strict"
"$venv/bin/mypy" --strict --python-version 3.10 --cache-dir "$scratch/mypy" -p whereabouts
