#!/usr/bin/env bash
# Sees to the browser in which the tests open the console: the one that CHROMIUM names, or Debian's.
set -euo pipefail

say() { printf 'chromium: %s\n' "$*" >&2; }

if command -v "${CHROMIUM:-chromium}" >/dev/null; then exit 0; fi
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say 'installing it: the tests open the console in it'
    install() { DEBIAN_FRONTEND=noninteractive apt-get install -qq chromium; }
    if { install || { apt-get update -qq && install; }; } >/dev/null 2>&1; then exit 0; fi
fi
say 'it is missing, and the tests open the console in it. Install it (apt-get install chromium, or your' \
    "system's package), or name a Chromium or Chrome with CHROMIUM=/path/to/it, and make again."
exit 1
