#!/bin/sh
# Run once, by the image of PostgreSQL, when its volume is new: a role that may do anything in its own database and
# nothing elsewhere. Only a superuser can make the extension, so it is here and not in the migrations.
set -eu
psql --set ON_ERROR_STOP=1 --set password="$WHEREABOUTS_DATABASE_PASSWORD" --username postgres <<'SQL'
CREATE ROLE whereabouts LOGIN PASSWORD :'password';
CREATE DATABASE whereabouts OWNER whereabouts;
REVOKE CONNECT ON DATABASE whereabouts FROM PUBLIC;
\connect whereabouts
CREATE EXTENSION vector;
SQL
