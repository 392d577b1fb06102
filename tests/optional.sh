#!/bin/sh
# Runs the tests that need an input which not every machine has, and lists those that it leaves out:
#
#     tests/optional.sh CARGO
#
# `cargo test` ignores these tests; they are in modules named after the input, such as needs_photographs. An input in
# WHEREABOUTS_TEST_REQUIRE ("photographs mount openvino", or some of these) must be there, or the script fails.
set -eu

[ $# -eq 1 ] || { sed -n '4,7s/^# \{0,1\}//p' "$0" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
cargo=$1 skipped="" required=${WHEREABOUTS_TEST_REQUIRE:-}

# optional INPUT TARGET HINT CHECK...: runs the tests of a test target that need the input, if the command CHECK
# succeeds.
optional() {
    input=$1 target=$2 hint=$3
    shift 3
    tests="$cargo test --release --locked --workspace --test $target -- --ignored needs_$input::"
    if "$@"; then
        $tests
    else
        count=$($tests --list | grep -c ': test$')
        skipped="$skipped
skipped: $count tests that need $input ($hint)"
        case " $required " in *" $input "*) missing="${missing:-} $input" ;; esac
    fi
}

may_mount() {
    folder=$(mktemp -d)
    mount -t tmpfs tmpfs "$folder" 2>/dev/null && umount "$folder" && may=0 || may=1
    rmdir "$folder"
    return "$may"
}

for input in $required; do
    case $input in photographs | openvino | mount) ;; *) echo "$0: no test needs $input" >&2; exit 2 ;; esac
done
optional photographs blackbox "set WHEREABOUTS_DATA to a folder with the sets corridor and tower" \
    test -d "${WHEREABOUTS_DATA:-$here/../../shared/data}/corridor"
optional openvino blackbox "run make openvino" test -f "$here/../assets/onnxruntime-openvino/libonnxruntime.so"
optional mount crash "run as a user who may mount a file system" may_mount

[ -z "$skipped" ] || echo "$skipped" >&2
if [ -n "${missing:-}" ]; then
    echo "missing, though WHEREABOUTS_TEST_REQUIRE names it:$missing" >&2
    exit 1
fi
