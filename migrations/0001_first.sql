-- Version 1: maps, images, jobs and what belongs to them.
--
-- Records are kept as JSON, in the words of the API; beside each are the columns that it is looked up by.
-- The descriptors of a map are in a table of their own, named descriptors_UID_REVISION, which is made
-- with the map: maps have different dimensions, a search is always in one map, and a new table beside
-- the old ones locks nobody out, while a new partition locks the whole partitioned table for a moment.

CREATE EXTENSION IF NOT EXISTS vector;

-- Processes say again and again that they are alive; what a dead one held is free.
CREATE TABLE processes (
    id uuid PRIMARY KEY,
    alive_until timestamptz NOT NULL
);

-- Whether a process may still be at work. Right after the database was started nobody could have said so,
-- and everybody counts as alive.
CREATE FUNCTION is_alive(process uuid, lifetime interval) RETURNS boolean
LANGUAGE sql STABLE AS $$
    SELECT pg_postmaster_start_time() > now() - lifetime
        OR EXISTS (SELECT FROM processes WHERE id = process AND alive_until > now())
$$;

CREATE TABLE maps (
    uid uuid PRIMARY KEY,
    name text COLLATE "C" NOT NULL UNIQUE,
    revision bigint NOT NULL,
    record json NOT NULL,
    -- Whether the HNSW index of its descriptors is there.
    graph boolean NOT NULL DEFAULT false,
    calibration json,
    -- Who measures it at the moment.
    measured_by uuid
);

-- Maps that were deleted, until what belonged to them is cleared away.
CREATE TABLE deleted_maps (
    uid uuid PRIMARY KEY
);

-- Descriptors in the making.
CREATE TABLE drafts (
    map_uid uuid PRIMARY KEY,
    revision bigint NOT NULL,
    holder uuid NOT NULL
);

CREATE TABLE images (
    map_uid uuid NOT NULL,
    id text COLLATE "C" NOT NULL,
    -- Its place in the order of addition.
    slot bigint GENERATED ALWAYS AS IDENTITY,
    digest bytea NOT NULL,
    -- Of the record, because PostgreSQL cannot look into one that has the character 0 in a text.
    pose json,
    record json NOT NULL,
    PRIMARY KEY (map_uid, id),
    UNIQUE (map_uid, slot)
);

-- How many images a map has and how often they changed, in parts, so that those who add images do not
-- wait for each other.
CREATE TABLE image_counts (
    map_uid uuid NOT NULL,
    part smallint NOT NULL,
    images bigint NOT NULL,
    changes bigint NOT NULL,
    PRIMARY KEY (map_uid, part)
);

-- Image bytes, which are in the object store, and how many images and queries need them.
CREATE TABLE blobs (
    digest bytea PRIMARY KEY,
    size bigint NOT NULL,
    needed bigint NOT NULL DEFAULT 0,
    pinned_until timestamptz NOT NULL
);
CREATE INDEX blobs_unneeded ON blobs (pinned_until) WHERE needed <= 0;

CREATE TABLE jobs (
    id uuid PRIMARY KEY,
    map text COLLATE "C" NOT NULL,
    state text NOT NULL,
    -- 0 goes first.
    place smallint NOT NULL,
    -- Nobody takes it before then: it is held, or is not to be tried before.
    held_until timestamptz,
    holder uuid,
    ended_at timestamptz,
    changed_at timestamptz NOT NULL DEFAULT now(),
    digest bytea NOT NULL,
    record json NOT NULL
) WITH (fillfactor = 70);
CREATE INDEX jobs_waiting ON jobs (place, id) WHERE ended_at IS NULL;
CREATE INDEX jobs_ended ON jobs (ended_at, id) WHERE ended_at IS NOT NULL;
CREATE INDEX jobs_by_map ON jobs (map, id);
CREATE INDEX jobs_by_state ON jobs (state, id);

CREATE TABLE usage (
    day date NOT NULL,
    map text COLLATE "C" NOT NULL,
    calls bigint NOT NULL,
    cached bigint NOT NULL,
    prompt_tokens bigint NOT NULL,
    completion_tokens bigint NOT NULL,
    estimated bigint NOT NULL,
    money double precision NOT NULL,
    PRIMARY KEY (day, map)
);

-- What calls in progress may cost at the most.
CREATE TABLE set_aside (
    day date NOT NULL,
    holder uuid NOT NULL,
    tokens bigint NOT NULL,
    money double precision NOT NULL,
    PRIMARY KEY (day, holder)
);

-- What is left of limits by the minute. After a crash of the database they begin anew.
CREATE UNLOGGED TABLE buckets (
    name text COLLATE "C" PRIMARY KEY,
    first double precision NOT NULL,
    second double precision NOT NULL,
    at timestamptz NOT NULL,
    -- Whether the last draw was granted.
    taken boolean NOT NULL
);

-- Descriptions of pairs that were paid for.
CREATE TABLE descriptions (
    key bytea PRIMARY KEY,
    size bigint NOT NULL,
    created_at timestamptz NOT NULL,
    used_at timestamptz NOT NULL,
    record json NOT NULL
);
CREATE INDEX descriptions_by_use ON descriptions (used_at);

-- Descriptions that somebody is buying at the moment.
CREATE TABLE purchases (
    key bytea PRIMARY KEY,
    holder uuid NOT NULL,
    until timestamptz NOT NULL
);

-- Frames whose pairs were described.
CREATE TABLE frames (
    map_uid uuid NOT NULL,
    query_id uuid NOT NULL,
    digest bytea NOT NULL,
    descriptor vector NOT NULL,
    PRIMARY KEY (map_uid, query_id)
);

CREATE TABLE keys (
    id text COLLATE "C" PRIMARY KEY,
    record json NOT NULL
);

-- First answers to requests that may be sent again.
CREATE TABLE answers (
    id text COLLATE "C" PRIMARY KEY,
    at timestamptz NOT NULL,
    -- Who is working on it; null once it is answered.
    holder uuid,
    record json NOT NULL
);
CREATE INDEX answers_by_age ON answers (at);

CREATE TABLE webhooks (
    id uuid PRIMARY KEY,
    record json NOT NULL
);

CREATE TABLE deliveries (
    webhook uuid NOT NULL REFERENCES webhooks ON DELETE CASCADE,
    id uuid NOT NULL,
    state text NOT NULL,
    -- When it is tried next, while it waits.
    due_at timestamptz,
    ended_at timestamptz,
    holder uuid,
    record json NOT NULL,
    body bytea NOT NULL,
    PRIMARY KEY (webhook, id)
);
CREATE INDEX deliveries_due ON deliveries (webhook, due_at, id) WHERE due_at IS NOT NULL;
CREATE INDEX deliveries_ended ON deliveries (ended_at, webhook, id) WHERE ended_at IS NOT NULL;
