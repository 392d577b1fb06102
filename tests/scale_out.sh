#!/bin/sh
# Runs the black-box tests against servers and workers that share a database, and a folder for pictures (or the
# object store in WHEREABOUTS_TEST_S3; tests/s3.sh starts one):
#
#     tests/scale_out.sh CARGO POSTGRES_VENV
set -eu

[ $# -eq 2 ] || { sed -n '2,5s/^# \{0,1\}//p' "$0" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
cargo=$1 postgres=$2

blackbox() {
    WHEREABOUTS_TEST_DEPLOYMENT=scale-out "$here/postgres.sh" "$postgres" \
        "$cargo" test --release --locked --workspace --test blackbox -- --include-ignored "$@"
}

# The skipped tests are about the data folder or do not reach the store: models, evaluation, admission control. They
# run against the embedded store. The test that restarts PostgreSQL runs alone.
# Four threads, because two would leave a two-core machine half idle.
blackbox --test-threads=4 \
    --skip doctor:: --skip schema:: --skip documented:: \
    --skip durability::a_second_server --skip durability::a_damaged_descriptor \
    --skip demo:: --skip dinov2:: --skip eval:: --skip model_files:: --skip models:: --skip overload:: \
    --skip real_images:: --skip smuggling::the_time_of_a_refusal \
    --skip five_hundred_jobs
blackbox five_hundred_jobs
