#!/usr/bin/env bash
# Every call of whereabouts in curl, against a running server:
#
#     curl.sh URL FOLDER
#
# An empty URL means http://127.0.0.1:8080, the server's default. An API key, if required, is read from
# WHEREABOUTS_API_KEY and not printed.
# FOLDER contains at least two JPEGs, such as demo-out/frames. The maps `curl-example` and `curl-copy` are created
# and deleted. Prints each command before running it; exits with 1 if a response is not the expected one.
set -euo pipefail

if [ $# -ne 2 ]; then
    echo "usage: $0 URL FOLDER, such as: $0 http://127.0.0.1:8080 demo-out/frames" >&2
    exit 2
fi
url=${1:-http://127.0.0.1:8080}
url=${url%/}
folder=$2
shopt -s nullglob
pictures=("$folder"/*.jpg "$folder"/*.jpeg)
if [ ${#pictures[@]} -lt 2 ]; then
    echo "$folder has fewer than two JPEGs; \`whereabouts demo\` renders some" >&2
    exit 1
fi
first=${pictures[0]} second=${pictures[1]}

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
body=$scratch/answer
headers=$scratch/headers
(umask 077 && printf '%s' "${WHEREABOUTS_API_KEY:+Authorization: Bearer $WHEREABOUTS_API_KEY}" > "$headers")
failed=0

# Prints an argument, quoted for a shell.
typed() {
    if [[ $1 =~ ^[A-Za-z0-9_./:=@%+,-]+$ ]]; then
        printf ' %s' "$1"
    else
        printf " '%s'" "${1//\'/\'\\\'\'}"
    fi
}

# call STATUS[|STATUS] ARGUMENT...: runs curl, prints the command and the start of the response, and saves the
# response in $body.
call() {
    local expected=$1 status argument
    shift
    printf '$ curl'
    for argument in "$@"; do typed "$argument"; done
    echo
    : > "$body"
    status=$(curl --silent --show-error --max-time 90 --header "@$headers" --output "$body" \
        --write-out '%{http_code}' "$@") || true
    if grep -qI . "$body"; then
        printf '%s %s\n\n' "$status" "$(head -c 240 "$body" | tr '\n' ' ')"
    else
        printf '%s (%s bytes)\n\n' "$status" "$(wc -c < "$body")"
    fi
    if [[ "|$expected|" != *"|$status|"* ]]; then
        echo "expected $expected, got $status" >&2
        failed=$((failed + 1))
    fi
}

# Prints the first match of a sed expression with one group in the last response.
pick() {
    sed -nE "s/$1/\1/p" "$body" | head -n 1
}

json='Content-Type: application/json'
jpeg='Content-Type: image/jpeg'

# Is the server up?
call 200 "$url/livez"
if [ "$failed" -gt 0 ]; then
    echo "$url does not answer; \`whereabouts serve\` starts a server" >&2
    exit 1
fi
call 200 "$url/readyz"

# Maps. Leftovers of an earlier run are deleted first.
call '204|404' -X DELETE "$url/maps/curl-example"
call '204|404' -X DELETE "$url/maps/curl-copy"
call 201 -X PUT "$url/maps/curl-example" -H "$json" -d '{"scene": "outdoor", "frame": "wgs84"}'
call 200 -X PUT "$url/maps/curl-example" -H "$json" -d '{"description": "made by curl.sh"}'
call 200 "$url/maps"
call 200 "$url/maps/curl-example"

# Images: the raw bytes with the pose in the query string, or a form.
call 201 -H "$jpeg" --data-binary "@$first" \
    "$url/maps/curl-example/images?id=gate&lat=45.0004&lon=-30.0005&heading=94&tags=north,gate"
call 201 -F "image=@$second" \
    -F 'meta={"id": "shed", "pose": {"lat": 45.0006, "lon": -30.0005}, "tags": ["north"]}' \
    "$url/maps/curl-example/images"
call 200 -H "$jpeg" --data-binary "@$first" "$url/maps/curl-example/images?id=gate"
call 409 -H "$jpeg" --data-binary "@$second" "$url/maps/curl-example/images?id=gate"

# Correct the pose, time or tags: a JSON merge patch, or the same upload again.
call 200 -X PATCH "$url/maps/curl-example/images/gate" -H "$json" \
    -d '{"pose": {"lat": 45.0005}, "captured_at": "2026-03-01T12:00:00Z", "tags": null}'
call 200 -H "$jpeg" --data-binary "@$first" "$url/maps/curl-example/images?id=gate&lat=45.0004&lon=-30.0005"
call 200 "$url/maps/curl-example/images?limit=1"
call 200 "$url/maps/curl-example/images?limit=1&cursor=$(pick '.*"next_cursor":"([^"]*)".*')"
call 200 "$url/maps/curl-example/images/gate"
call 200 "$url/maps/curl-example/images/gate/content"
call 200 "$url/maps/curl-example/images/gate/content?max_edge=160"

# Frames.
call 200 -H "$jpeg" --data-binary "@$first" "$url/localize?map=curl-example&k=5&refine=off"
call 200 -F "image=@$second" "$url/localize?map=curl-example&refine=wait&priority=high"
call 200 -H "$jpeg" -H 'X-Deadline-Ms: 20000' --data-binary "@$first" "$url/localize?map=curl-example"
job=$(pick '.*"job":\{"id":"([^"]*)".*')
call 200 -H "$jpeg" --data-binary "@$second" \
    "$url/localize?map=curl-example&refine=off&track=robot-7&captured_at=2026-03-01T12:00:02Z&moved_m=16.5"
call 200 "$url/maps/curl-example/tracks"
call 200 "$url/maps/curl-example/tracks/robot-7"
call 404 -H "$jpeg" --data-binary "@$first" "$url/localize?map=curl-nowhere"
# A description instead of a frame. 409: nothing was read in the map, because no reader is installed or it goes on.
call '200|409' "$url/localize?map=curl-example" -d '{"text": "opposite the pharmacy"}'

# Jobs. A succeeded job cannot be retried.
call 200 "$url/jobs/$job?wait=30"
call 200 -N "$url/jobs/$job/events"
call 200 "$url/jobs?map=curl-example&state=succeeded&limit=2"
call 200 "$url/jobs?map=curl-example&q=gate"
call 200 "$url/jobs/$job/frame?max_edge=160"
call '200|404' "$url/jobs/$job/matches/gate"
call 200 -X POST "$url/jobs/$job/cancel"
call '200|409' -X POST "$url/jobs/$job/retry"

# Export and import between servers: the map, then each image with its descriptor and bytes.
call 200 "$url/maps/curl-example/export?limit=1"
map=$(pick '^\{"map":(\{.*\}),"images":\[.*')
map=${map/'"name":"curl-example"'/'"name":"curl-copy"'}
image=$(pick '.*"images":\[(.*)\],"next_cursor":.*')
id=$(pick '.*"image":\{"id":"([^"]*)".*')
echo "$map" > "$scratch/map.json"
echo "{\"map\":$map,\"image\":$image}" > "$scratch/meta.json"
call 200 "$url/maps/curl-example/images/$id/content"
cp "$body" "$scratch/picture"
# Only a map with a vocabulary of its own has one to export.
call 404 "$url/maps/curl-example/vocabulary"
call 201 -X PUT "$url/maps/curl-copy/import" -H "$json" -d "@$scratch/map.json"
call 201 -F "image=@$scratch/picture" -F "meta=<$scratch/meta.json" "$url/maps/curl-copy/import"

# Batch upload: a form, or an archive with a metadata file next to each image.
call 200 -F 'meta={"id": "gate"}' -F "image=@$first" -F "image=@$second" "$url/maps/curl-copy/images:batch"
cp "$first" "$scratch/arch.jpg"
echo '{"pose": {"lat": 45.0007, "lon": -30.0005}}' > "$scratch/arch.jpg.json"
tar c -C "$scratch" arch.jpg arch.jpg.json > "$scratch/images.tar"
call 200 -H 'Content-Type: application/x-tar' --data-binary "@$scratch/images.tar" \
    "$url/maps/curl-copy/images:batch"

# Reindex: recompute the descriptors in the background.
call 202 -X POST "$url/maps/curl-example/reindex" -H "$json" -d '{}'

# API keys: only this response contains the key.
call 201 "$url/keys" -H "$json" -d '{"name": "made by curl.sh", "role": "robot", "maps": ["curl-example"]}'
key=$(pick '.*"key":\{"id":"([^"]*)".*')
call 200 "$url/keys"
call 200 -X DELETE "$url/keys/$key"

# Webhooks: notify a program when a job ends. Only this response contains the secret.
call 201 "$url/webhooks" -H "$json" -d '{"url": "https://fleet.example.com/hooks", "map": "curl-example"}'
webhook=$(pick '.*"id":"([^"]*)".*')
call 200 "$url/webhooks"
call 200 "$url/webhooks/$webhook"
call 202 -X POST "$url/webhooks/$webhook/test"
call 200 "$url/webhooks/$webhook/deliveries?limit=2"
delivery=$(pick '.*"deliveries":\[\{"id":"([^"]*)".*')
call '202|409' -X POST "$url/webhooks/$webhook/deliveries/$delivery/redeliver"
call 204 -X DELETE "$url/webhooks/$webhook"

# Operations.
call 200 "$url/status"
call 200 "$url/usage?map=curl-example&days=7"

# Descriptions that were paid for: none, unless the refiner is mllm.
description=$(printf '0%.0s' $(seq 64))
call 200 "$url/descriptions?map=curl-example"
call 404 "$url/descriptions/$description"
call 404 -X DELETE "$url/descriptions/$description"
call 200 -X DELETE "$url/descriptions?map=curl-example"
call 200 "$url/metrics"
call 200 "$url/openapi.json"
call 200 "$url/docs"

call 204 -X DELETE "$url/maps/curl-example/images/shed"
call 204 -X DELETE "$url/maps/curl-example"
call 204 -X DELETE "$url/maps/curl-copy"

if [ "$failed" -gt 0 ]; then
    echo "$failed calls did not get the expected response" >&2
    exit 1
fi
echo "every call got the expected response"
