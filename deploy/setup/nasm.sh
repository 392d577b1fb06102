#!/usr/bin/env bash
# Makes sure that nasm is installed; the SIMD code of the JPEG decoder needs it on x86-64. Without it
# the build uses plain C code, which decodes the same pixels more slowly.
set -euo pipefail

say() { printf 'nasm: %s\n' "$*" >&2; }

case "$(uname -m)" in x86_64 | amd64) ;; *) exit 0 ;; esac
if command -v nasm >/dev/null; then exit 0; fi
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say 'installing nasm, which makes the JPEG decoder faster'
    install() { DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-install-recommends nasm; }
    if { install || { apt-get update -qq && install; }; } >/dev/null 2>&1; then exit 0; fi
fi
say 'nasm is missing, so JPEG decoding will be slower. To fix that: apt-get install nasm (or dnf, brew),' \
    'cargo clean --release -p mozjpeg-sys, and run make again.'
