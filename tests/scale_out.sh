#!/bin/sh
# Runs the black-box tests against servers and workers that share a database and an object store:
#
#     tests/scale_out.sh CARGO POSTGRES_VENV S3_VENV
set -eu

[ $# -eq 3 ] || { sed -n '2,4s/^# \{0,1\}//p' "$0" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
cargo=$1 postgres=$2 s3=$3

blackbox() {
    WHEREABOUTS_TEST_DEPLOYMENT=scale-out "$here/postgres.sh" "$postgres" "$here/s3.sh" "$s3" \
        "$cargo" test --release --locked --test blackbox -- --include-ignored "$@"
}

# What these are about lies in a data folder, or before the store: connections, bodies, models, commands that ask no
# server. They run against the embedded store. The test that restarts PostgreSQL has one of its own.
blackbox \
    --skip doctor:: --skip schema:: --skip documented:: \
    --skip durability::a_second_server --skip durability::a_damaged_descriptor \
    --skip bad_input:: --skip cli:: --skip demo:: --skip dinov2:: --skip eval:: --skip http2:: \
    --skip model_files:: --skip models:: --skip overload:: --skip real_images:: --skip slow_clients:: \
    --skip smuggling:: --skip tls:: \
    --skip five_hundred_jobs
blackbox five_hundred_jobs
