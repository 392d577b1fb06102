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

# What these are about lies in a data folder, or ends before the store: models, an evaluation, the line of pictures
# that wait. They run against the embedded store. The test that restarts PostgreSQL has one of its own.
# Two at a time would leave a machine of two cores half idle.
blackbox --test-threads=4 \
    --skip doctor:: --skip schema:: --skip documented:: \
    --skip durability::a_second_server --skip durability::a_damaged_descriptor \
    --skip demo:: --skip dinov2:: --skip eval:: --skip model_files:: --skip models:: --skip overload:: \
    --skip real_images:: --skip smuggling::the_time_of_a_refusal \
    --skip five_hundred_jobs
blackbox five_hundred_jobs
