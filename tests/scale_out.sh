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

# Tests in a module `embedded_only` run against the embedded store alone, and those in a module `alone` disturb all
# others. Four threads, because two would leave a two-core machine half idle.
blackbox --test-threads=4 --skip embedded_only:: --skip alone::
blackbox alone::
