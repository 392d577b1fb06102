#!/usr/bin/env bash
# Localizes the frames of a folder again and again, several at a time, and says how fast that went:
#
#     localize.sh URL MAP FOLDER [CLIENTS] [REQUESTS]
#
# REFINE=async has jobs made too; the default is off. Ends with 1 if any answer is other than 200 or 429.
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
