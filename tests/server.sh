# Sourced by the scripts that start a server; not run by itself.
# shellcheck shell=bash

# arguments SCRIPT BINARY VENV: sets $binary and $venv to the absolute paths of the arguments of a script, and changes to
# its folder. VENV is a Python virtual environment; `environment` creates it if it is missing.
arguments() {
    local folder
    folder=$(dirname "$1")
    if [ $# -ne 3 ]; then
        echo "usage: $1 BINARY VENV, such as: $1 target/release/whereabouts" \
            "target/$(basename "$(realpath "$folder")")-venv" >&2
        exit 2
    fi
    # shellcheck disable=SC2034 # used by the sourcing script
    binary=$(realpath "$2")
    # shellcheck disable=SC2034 # used by the sourcing script
    venv=$(realpath -m "$3")
    cd "$folder" || exit
}

# no_panic: fails if the server has panicked.
no_panic() {
    if grep panicked "$scratch/log" >&2; then exit 1; fi
}

# environment FOLDER REQUIREMENTS...: creates a Python virtual environment with these requirements files, or recreates
# it if they have changed.
environment() {
    local folder=$1 files=() file
    shift
    if cat "$@" | cmp -s - "$folder/complete"; then return; fi
    for file in "$@"; do files+=(-r "$file"); done
    python3 -m venv "$folder"
    "$folder/bin/pip" install --quiet --disable-pip-version-check "${files[@]}"
    cat "$@" > "$folder/complete"
}

# free_port VENV: prints a free local port.
free_port() {
    "$1/bin/python" -c 'import socket
with socket.socket() as s: s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'
}

# browser: sets $CHROMIUM to the path of a browser.
browser() {
    if ! CHROMIUM=$(command -v "${CHROMIUM:-chromium}"); then
        echo "chromium, needed to open the console, is not installed: apt-get install chromium" >&2
        exit 1
    fi
}

# town BINARY PLACES: creates $scratch/town, a demo town with that many places, its frames, and the data folder of a
# server that has localized them.
town() {
    if ! "$1" demo --offline --json --places "$2" --out "$scratch/town" > "$scratch/demo" 2>&1; then
        cat "$scratch/demo" >&2
        exit 1
    fi
}

# $scratch is a temporary folder, removed when the script ends, after the server has been stopped.
scratch=$(mktemp -d)
server=
finish() {
    if [ -n "$server" ]; then
        kill "$server" 2> /dev/null || true
        wait "$server" 2> /dev/null || true
    fi
    rm -rf "$scratch"
}
trap finish EXIT

# serve BINARY: starts a server and waits until it is ready; its URL is $url, its log $scratch/log.
serve() {
    "$1" serve --data "$scratch/data" --listen 127.0.0.1:0 --address-file "$scratch/address" \
        > "$scratch/log" 2>&1 &
    server=$!
    for _ in $(seq 300); do
        if [ -s "$scratch/address" ] || ! kill -0 "$server" 2> /dev/null; then break; fi
        sleep 0.1
    done
    if [ ! -s "$scratch/address" ]; then
        echo "the server did not start:" >&2
        cat "$scratch/log" >&2
        exit 1
    fi
    # shellcheck disable=SC2034 # used by the sourcing script
    url=http://$(cat "$scratch/address")
}
