#!/usr/bin/env bash
# Localizes the frames of a folder repeatedly and concurrently, and reports throughput and latency:
#
#     localize.sh URL MAP FOLDER [CLIENTS] [REQUESTS]
#
# REFINE=async creates jobs too (default: off). Exits with 1 if a response is neither 200 nor 429.
set -euo pipefail
# shellcheck source-path=SCRIPTDIR source=summary.sh
. "$(dirname "$0")/summary.sh"

arguments 4 200 "$@"
timings=$(mktemp)
trap 'rm -f "$timings"' EXIT

start=$(now)
frames_configuration "${REFINE:-off}" /dev/null | in_parallel "$clients" > "$timings"
echo "POST /localize (refine=${REFINE:-off}), $requests frames by $clients clients"
summary "$timings" "$(between "$start" "$(now)")"
acceptable "$timings"
