# Sourced by the scripts in this folder; not run by itself.
# shellcheck shell=bash

# Summarizes lines "STATUS SECONDS" as a table: responses by status, throughput, and latency percentiles (nearest
# rank) of those with status 200.
#     summary FILE WALL_SECONDS
summary() {
    local file=$1 wall=$2
    awk '{ count[$1]++ } END { for (status in count) print status, count[status] }' "$file" | sort |
        while read -r status count; do
            case $status in
                000) echo "no answer     $count" ;;
                *) echo "status $status    $count" ;;
            esac
        done
    awk '$1 == 200 { print $2 * 1000 }' "$file" | sort -n | awk -v wall="$wall" '
        { ms[NR] = $1 }
        function percentile(p,  rank) {
            rank = int(NR * p / 100)
            if (rank < NR * p / 100) rank++
            return ms[rank < 1 ? 1 : rank]
        }
        END {
            printf "seconds       %.2f\n", wall
            if (NR == 0) exit
            printf "200 per s     %.1f\n", NR / wall
            printf "ms            p50 %.1f  p90 %.1f  p95 %.1f  p99 %.1f  max %.1f\n",
                percentile(50), percentile(90), percentile(95), percentile(99), ms[NR]
        }'
}

# Succeeds if there was a 200 and every status is 200 or 429 (overloaded).
acceptable() {
    awk '$1 == 200 { served++ } $1 != 200 && $1 != 429 { other++ } END { exit !(served && !other) }' "$1"
}

# arguments CLIENTS REQUESTS "$@": parses the arguments of a script into $url, $map, $folder, $clients and $requests
# (the first two are the defaults of the last two), and the API key, if any, into the header $key.
arguments() {
    if [ $# -lt 5 ]; then
        echo "usage: $0 URL MAP FOLDER [CLIENTS] [REQUESTS]" >&2
        exit 2
    fi
    url=${3%/} map=$4 folder=$5
    # shellcheck disable=SC2034 # used by the sourcing script
    clients=${6:-$1}
    requests=${7:-$2}
    key=${WHEREABOUTS_API_KEY:+Authorization: Bearer $WHEREABOUTS_API_KEY}
    read_frames "$folder"
}

# frames_configuration REFINE OUTPUT: prints the curl configuration that posts $requests frames. OUTPUT is the file of
# the response, where # stands for the request number.
frames_configuration() {
    local number
    for ((number = 0; number < requests; number++)); do
        if [ "$number" -gt 0 ]; then echo next; fi
        cat << END
url = "$url/localize?map=$map&refine=$1"
request = POST
upload-file = "${frames[number % ${#frames[@]}]}"
header = "Content-Type: image/jpeg"
header = "Expect:"
header = "$key"
max-time = 120
output = "${2//\#/$number}"
write-out = "%{http_code} %{time_total}\n"
END
    done
}

# Reads the JPEGs of a folder into the array `frames`.
read_frames() {
    shopt -s nullglob
    frames=("$1"/*.jpg "$1"/*.jpeg)
    if [ ${#frames[@]} -eq 0 ]; then
        echo "$1 has no JPEGs; \`whereabouts demo\` renders some in demo-out/frames" >&2
        exit 1
    fi
}

# Prints the current time in seconds, with a fraction.
now() {
    echo "${EPOCHREALTIME/,/.}"
}

# in_parallel CLIENTS: runs the transfers of the configuration on stdin, up to CLIENTS at a time. Failed transfers are
# counted by their status, so curl's exit code is ignored.
in_parallel() {
    curl --parallel --parallel-immediate --parallel-max "$1" --no-progress-meter --config - || true
}

# Prints the seconds between two values of `now`.
between() {
    awk -v from="$1" -v to="$2" 'BEGIN { printf "%.3f\n", to - from }'
}
