#!/usr/bin/env bash
# Fuzzes one target with libFuzzer and coverage on the stable toolchain; a failing input is kept in
# fuzz/artifacts/TARGET/, from where it belongs into tests/fuzz/found/ once it is mended.
#
# usage: fuzz/run.sh TARGET [LIBFUZZER OPTION...]
#        TARGET is a file in fuzz/fuzz_targets; an option is, say, -runs=100000
set -euo pipefail
cd "$(dirname "$0")"

target=${1:?usage: fuzz/run.sh TARGET [LIBFUZZER OPTION...]}
shift
# What cargo-fuzz sets, less the sanitizer, which needs a nightly compiler.
RUSTFLAGS="-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
  -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
  -Cllvm-args=-sanitizer-coverage-trace-compares -Ccodegen-units=1 --cfg fuzzing" \
  cargo build --release --bin "$target" --target "$(rustc -vV | sed -n 's/host: //p')"
mkdir -p "corpus/$target" "artifacts/$target"
exec "target/$(rustc -vV | sed -n 's/host: //p')/release/$target" \
  "-artifact_prefix=artifacts/$target/" -max_len=65536 "corpus/$target" "$@"
