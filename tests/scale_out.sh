#!/bin/sh
# Runs the black-box tests against servers and workers that share a database, and a folder for pictures (or what
# WHEREABOUTS_TEST_S3 names; tests/store has a server that speaks S3):
#
#     tests/scale_out.sh CARGO POSTGRES_VENV
set -eu

[ $# -eq 2 ] || { sed -n '2,5s/^# \{0,1\}//p' "$0" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
cargo=$1 postgres=$2

blackbox() {
    WHEREABOUTS_TEST_DEPLOYMENT=scale-out "$here/postgres.sh" "$postgres" \
        "$cargo" test --release --locked --test blackbox -- --include-ignored "$@"
}

# What these are about lies in a data folder, or before the store: connections, bodies, models, commands that ask no
# server; or in how a process alone in its folder takes up what it was killed in. They run against the embedded store.
# The test that restarts PostgreSQL has one of its own.
blackbox \
    --skip doctor:: --skip schema:: --skip documented:: \
    --skip durability::a_second_server --skip durability::a_damaged_descriptor \
    --skip reindex::an_image_that_cannot_be_taken_over --skip reindex::kill_9 \
    --skip bad_input:: --skip cli:: --skip demo:: --skip dinov2:: --skip eval:: --skip http2:: \
    --skip model_files:: --skip models:: --skip overload:: --skip real_images:: --skip slow_clients:: \
    --skip smuggling:: --skip tls:: \
    --skip five_hundred_jobs
blackbox five_hundred_jobs
