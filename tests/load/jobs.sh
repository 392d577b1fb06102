#!/usr/bin/env bash
# Localizes frames concurrently with refine=async, waits for their jobs, and reports the throughput and latency of
# both:
#
#     jobs.sh URL MAP FOLDER [CLIENTS] [REQUESTS]
#
# WAIT_S is how long to wait for all jobs, in seconds (default 300). Exits with 1 if a response is neither 200 nor
# 429, or if a job does not succeed within that time.
set -euo pipefail
# shellcheck source-path=SCRIPTDIR source=summary.sh
. "$(dirname "$0")/summary.sh"

arguments 4 100 "$@"
wait_s=${WAIT_S:-300}
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

# Prints the curl configuration that gets the jobs whose ids are in a file; each response goes to job-ID.
job_configuration() {
    local id separator=
    while read -r id; do
        printf '%s' "$separator"
        separator=$'next\n'
        cat << END
url = "$url/jobs/$id?wait=10"
header = "$key"
max-time = 60
output = "$scratch/job-$id"
write-out = "%{http_code} %{time_total}\n"
END
    done < "$1"
}

start=$(now)
frames_configuration async "$scratch/answer-#" | in_parallel "$clients" > "$scratch/posts"
echo "POST /localize (refine=async), $requests frames by $clients clients"
summary "$scratch/posts" "$(between "$start" "$(now)")"

# Not every frame has a job: under load the service sheds jobs before frames.
sed -nE 's/.*"job":\{"id":"([^"]*)".*/\1/p' "$scratch"/answer-* | awk 1 > "$scratch/ids"
made=$(wc -l < "$scratch/ids")
cp "$scratch/ids" "$scratch/open"
: > "$scratch/gets"
waiting=$(now)
while [ -s "$scratch/open" ]; do
    if awk -v waited="$(between "$waiting" "$(now)")" -v most="$wait_s" 'BEGIN { exit !(waited > most) }'; then
        break
    fi
    job_configuration "$scratch/open" | in_parallel "$clients" >> "$scratch/gets"
    while read -r id; do
        grep -qE '"state":"(succeeded|degraded|failed|cancelled)"' "$scratch/job-$id" 2> /dev/null || echo "$id"
    done < "$scratch/open" > "$scratch/still"
    mv "$scratch/still" "$scratch/open"
done
ended=$(now)
echo
echo "GET /jobs/{id}?wait=10, $made jobs by $clients clients; $((requests - made)) frames without a job"
summary "$scratch/gets" "$(between "$waiting" "$ended")"

# Prints each job's state and the seconds from being queued to its end.
while read -r id; do
    cat "$scratch/job-$id" 2> /dev/null || true
    echo
done < "$scratch/ids" | awk '
    function field(name,  found) {
        if (!match($0, "\"" name "\":\"[^\"]*\"")) return ""
        found = substr($0, RSTART, RLENGTH)
        sub(/^"[^"]*":"/, "", found)
        sub(/"$/, "", found)
        return found
    }
    # Seconds since a fixed day, by the Gregorian calendar.
    function seconds(moment,  p, y, m) {
        split(moment, p, /[-T:Z]/)
        y = p[1]; m = p[2]
        if (m < 3) { y--; m += 12 }
        return (365 * y + int(y / 4) - int(y / 100) + int(y / 400) + int((153 * m - 457) / 5) + p[3]) * 86400 \
            + p[4] * 3600 + p[5] * 60 + p[6]
    }
    {
        state = field("state")
        if (state == "") state = "no_response"
        if (field("finished_at") == "") print state, "-"
        else printf "%s %.4f\n", state, seconds(field("finished_at")) - seconds(field("created_at"))
    }' > "$scratch/ends"
echo
echo "jobs, from being queued to their end"
awk '{ count[$1]++ } END { for (state in count) printf "%-13s %d\n", state, count[state] }' "$scratch/ends" | sort
awk '$1 == "succeeded" { print 200, $2 }' "$scratch/ends" > "$scratch/lasted"
summary "$scratch/lasted" "$(between "$start" "$ended")" | sed -e '/^status/d' -e 's/^200 per s /jobs per s/'

acceptable "$scratch/posts"
if [ "$made" -eq 0 ]; then
    echo "no frame had a job; is refinement on (refine.refiner), and does the map have images?" >&2
    exit 1
fi
acceptable "$scratch/gets"
! grep -qv '^succeeded ' "$scratch/ends"
