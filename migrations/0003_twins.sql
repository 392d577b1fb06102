-- Version 3: images with equal descriptors are one row of a map's HNSW index.
--
-- pgvector links each of many equal rows to others of them only: a search that gets among them does not get
-- out, and every other image of that part of the map is lost. Of the images whose descriptors are equal in 16
-- bits, which is what the index compares, it therefore has one, the *first*. The others are its *twins*,
-- which a search looks up by the code that they share. The triggers below keep one first for each code. A
-- table of descriptors gets them, and its column `twin`, right before its index is built, so that they hold
-- for servers of the previous version too.

-- The revision whose firsts are indexed; it replaces `graph`, which the previous version reads.
ALTER TABLE maps ADD COLUMN indexed_revision bigint;

-- Equal for descriptors that the index cannot tell apart.
CREATE FUNCTION descriptor_code(descriptor vector) RETURNS uuid
LANGUAGE sql IMMUTABLE STRICT PARALLEL SAFE
RETURN md5(halfvec_send(descriptor::halfvec))::uuid;

CREATE FUNCTION mark_twin() RETURNS trigger
LANGUAGE plpgsql AS $$
DECLARE
    first bigint;
BEGIN
    -- The lock keeps the first until this row can be seen by whoever removes it.
    EXECUTE format(
        'SELECT slot FROM %I.%I WHERE descriptor_code(descriptor) = descriptor_code($1) AND NOT twin
         LIMIT 1 FOR KEY SHARE', TG_TABLE_SCHEMA, TG_TABLE_NAME)
        INTO first USING NEW.descriptor;
    NEW.twin := first IS NOT NULL;
    RETURN NEW;
END
$$;

CREATE FUNCTION replace_first() RETURNS trigger
LANGUAGE plpgsql AS $$
DECLARE
    next bigint;
    twins boolean := true;
BEGIN
    -- A twin that is being removed at the same time is no longer there once its lock is free.
    WHILE next IS NULL AND twins LOOP
        EXECUTE format(
            'SELECT slot FROM %I.%I WHERE descriptor_code(descriptor) = descriptor_code($1) AND twin
             LIMIT 1 FOR UPDATE', TG_TABLE_SCHEMA, TG_TABLE_NAME)
            INTO next USING OLD.descriptor;
        EXECUTE format(
            'SELECT EXISTS (SELECT FROM %I.%I
             WHERE descriptor_code(descriptor) = descriptor_code($1) AND twin)',
            TG_TABLE_SCHEMA, TG_TABLE_NAME)
            INTO twins USING OLD.descriptor;
    END LOOP;
    EXECUTE format('UPDATE %I.%I SET twin = false WHERE slot = $1', TG_TABLE_SCHEMA, TG_TABLE_NAME)
        USING next;
    RETURN NULL;
END
$$;
