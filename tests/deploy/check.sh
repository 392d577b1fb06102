#!/usr/bin/env bash
# Checks the files of deploy/ against the server that they run: starts it the same way, generates traffic until every
# metric exists, and checks that each query of the alert rules and the dashboard finds its metric and labels, that
# every setting exists, that the files agree on names, ports and times, and that each file is valid.
#
#     check.sh BINARY VENV
#
# VENV is the folder of a Python virtual environment (requirements.txt); it is created if missing. After that, a run
# takes about half a minute. Exits with 1 if anything fails, and prints at the end which checks could not be run.
# Uses docker compose, haproxy, kubectl (or kustomize), promtool and systemd-analyze where they are installed.
set -euo pipefail
# shellcheck source-path=SCRIPTDIR source=../server.sh
. "$(dirname "$0")/../server.sh"
arguments "$0" "$@"
environment "$venv" requirements.txt

"$venv/bin/shellcheck" --external-sources check.sh ../../deploy/database/whereabouts.sh
echo "check.sh, whereabouts.sh: shellcheck found no problems"
"$venv/bin/hadolint" ../../Dockerfile
echo "Dockerfile: hadolint found no problems"

# The external services: an MLLM and two webhook receivers.
export PYTHONDONTWRITEBYTECODE=1
"$venv/bin/python" outside.py "$scratch/outside" &
outside=$!
trap 'kill "$outside" 2> /dev/null || true; finish' EXIT

town "$binary" 6
cp -r "$scratch/town/data" "$scratch/data"
"$binary" config --defaults > "$scratch/defaults.toml"
for role in admin operator robot; do
    "$binary" keys create --data "$scratch/data" --name "$role" --role "$role" 2> /dev/null > "$scratch/$role.key"
done
# Settings that make metrics appear within seconds which would otherwise take days.
export WHEREABOUTS_AUTH__KEYS=required WHEREABOUTS_MODEL__NAME=xfeat WHEREABOUTS_JOBS__SWEEP_S=1
export WHEREABOUTS_INDEX__EXACT_UP_TO=1 WHEREABOUTS_INDEX__CHECK_S=1
export WHEREABOUTS_REFINE__REFINER=mllm WHEREABOUTS_REFINE__CANDIDATES=2
WHEREABOUTS_MLLM__BASE_URL=$(cat "$scratch/outside")/v1
export WHEREABOUTS_MLLM__BASE_URL
export WHEREABOUTS_WEBHOOKS__ALLOW_PRIVATE=true WHEREABOUTS_WEBHOOKS__RETRY_S='[1]'
serve "$binary"
BINARY=$binary SCRATCH=$scratch URL=$url OUTSIDE=$(cat "$scratch/outside") \
    timeout 120 "$venv/bin/python" -m unittest
no_panic

echo
echo "Not run by this script: building the image, starting the Compose files, applying the manifests to a cluster,"
echo "starting the units with systemd, and rendering the dashboard in Grafana."
missing() { echo "Not run, because $1 is not installed: $2."; }
command -v kubectl kustomize > /dev/null || missing kubectl "building the manifests with kustomize"
command -v promtool > /dev/null || missing promtool "checking prometheus.yml and scale.yml, and running alerts_test.yaml"
command -v haproxy > /dev/null || missing haproxy "validating haproxy.cfg"
command -v systemd-analyze > /dev/null || missing systemd-analyze "verifying the units"
docker compose version > /dev/null 2>&1 || missing "docker compose" "validating the Compose files"
