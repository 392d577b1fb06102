#!/usr/bin/env bash
# Localizes the frames of a folder again and again, several at a time, and says how fast that went:
#
#     localize.sh URL MAP FOLDER [CLIENTS] [REQUESTS]
#
# REFINE=async has jobs made too; the default is off. Ends with 1 if any answer is other than 200 or 429.
set -euo pipefail
# shellcheck source-path=SCRIPTDIR source=summary.sh
. "$(dirname "$0")/summary.sh"

usage="usage: $0 URL MAP FOLDER [CLIENTS] [REQUESTS]"
if [ $# -lt 3 ]; then
    echo "$usage" >&2
    exit 2
fi
url=$1 map=$2 folder=$3
clients=${4:-4} requests=${5:-200}
frames=()
key=${WHEREABOUTS_API_KEY:+Authorization: Bearer $WHEREABOUTS_API_KEY}
read_frames "$folder"
timings=$(mktemp)
trap 'rm -f "$timings"' EXIT

configuration() {
    local number
    for ((number = 0; number < requests; number++)); do
        if [ "$number" -gt 0 ]; then echo next; fi
        cat << END
url = "${url%/}/localize?map=$map&refine=${REFINE:-off}"
request = POST
upload-file = "${frames[number % ${#frames[@]}]}"
header = "Content-Type: image/jpeg"
header = "Expect:"
header = "$key"
max-time = 120
output = /dev/null
write-out = "%{http_code} %{time_total}\n"
END
    done
}

start=$(now)
configuration | in_parallel "$clients" > "$timings"
echo "POST /localize (refine=${REFINE:-off}), $requests frames by $clients clients"
summary "$timings" "$(between "$start" "$(now)")"
acceptable "$timings"
