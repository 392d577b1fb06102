#!/bin/sh
# Run once by the PostgreSQL image, when its volume is new. Creates a role that owns its own database and has no access
# to others. Only a superuser can create the extension, so that is done here and not in the migrations.
set -eu
psql --set ON_ERROR_STOP=1 --set password="$WHEREABOUTS_DATABASE_PASSWORD" --username postgres <<'SQL'
CREATE ROLE whereabouts LOGIN PASSWORD :'password';
CREATE DATABASE whereabouts OWNER whereabouts;
REVOKE CONNECT ON DATABASE whereabouts FROM PUBLIC;
\connect whereabouts
CREATE EXTENSION vector;
SQL
