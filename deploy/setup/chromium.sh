#!/usr/bin/env bash
# Makes sure that there is a browser for the console tests: the one named by CHROMIUM, or Debian's.
set -euo pipefail

say() { printf 'chromium: %s\n' "$*" >&2; }

if command -v "${CHROMIUM:-chromium}" >/dev/null; then exit 0; fi
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say 'installing chromium for the console tests'
    install() { DEBIAN_FRONTEND=noninteractive apt-get install -qq chromium; }
    if { install || { apt-get update -qq && install; }; } >/dev/null 2>&1; then exit 0; fi
fi
say 'chromium is missing, and the console tests need it. Install it (apt-get install chromium, or your' \
    "system's package), or set CHROMIUM=/path/to/chromium-or-chrome, and run make again."
exit 1
