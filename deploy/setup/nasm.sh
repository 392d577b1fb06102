#!/usr/bin/env bash
# Sees to the assembler that the JPEG decoder's vector code needs on x86-64. Without it the build
# goes on with plain C code, which decodes the same pixels but takes longer.
set -euo pipefail

say() { printf 'nasm: %s\n' "$*" >&2; }

case "$(uname -m)" in x86_64 | amd64) ;; *) exit 0 ;; esac
if command -v nasm >/dev/null; then exit 0; fi
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say 'installing it: the JPEG decoder is faster with it'
    install() { DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-install-recommends nasm; }
    if { install || { apt-get update -qq && install; }; } >/dev/null 2>&1; then exit 0; fi
fi
say 'it is missing, so JPEGs will be decoded more slowly. To mend that: apt-get install nasm (or' \
    'dnf, brew), cargo clean --release -p mozjpeg-sys, and make again.'
