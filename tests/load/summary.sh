# Shared by the scripts here; not run by itself.
# shellcheck shell=bash

# Lines "STATUS SECONDS" as a table: answers by status, how many a second, and percentiles (nearest rank) of
# those with the status 200.
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
            printf "200 a second  %.1f\n", NR / wall
            printf "ms            p50 %.1f  p90 %.1f  p95 %.1f  p99 %.1f  max %.1f\n",
                percentile(50), percentile(90), percentile(95), percentile(99), ms[NR]
        }'
}

# Whether there was an answer with 200, and none but 200 and 429 (overloaded, as the service may say).
acceptable() {
    awk '$1 == 200 { served++ } $1 != 200 && $1 != 429 { other++ } END { exit !(served && !other) }' "$1"
}

# The JPEGs of a folder, as the array `frames`.
read_frames() {
    shopt -s nullglob
    frames=("$1"/*.jpg "$1"/*.jpeg)
    if [ ${#frames[@]} -eq 0 ]; then
        echo "$1 has no JPEGs; \`whereabouts demo\` draws some in demo-out/frames" >&2
        exit 1
    fi
}

# A moment in seconds, with a fraction.
now() {
    echo "${EPOCHREALTIME/,/.}"
}

# in_parallel CLIENTS: runs the transfers that the configuration on stdin names, so many at a time.
# Failed ones are counted by their status, so that curl's own exit code says nothing new.
in_parallel() {
    curl --parallel --parallel-immediate --parallel-max "$1" --no-progress-meter --config - || true
}

# Prints "SECONDS" between two values of `now`.
between() {
    awk -v from="$1" -v to="$2" 'BEGIN { printf "%.3f\n", to - from }'
}
