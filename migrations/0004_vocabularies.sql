-- Version 4: vocabularies that were fitted on the images of a map. Their bytes are blobs.

-- SHA-256 of the map's own vocabulary. Of the record, like the other columns, because PostgreSQL cannot look
-- into one that has the character 0 in a text.
ALTER TABLE maps ADD COLUMN vocabulary bytea;

-- Counts the references to vocabularies, also when a server of the previous version deletes a map.
CREATE FUNCTION count_vocabulary() RETURNS trigger
LANGUAGE plpgsql AS $$
BEGIN
    IF TG_OP <> 'DELETE' AND NEW.vocabulary IS NOT NULL THEN
        UPDATE blobs SET needed = needed + 1 WHERE digest = NEW.vocabulary;
        IF NOT FOUND THEN
            RAISE EXCEPTION 'the bytes of the vocabulary of the map % are not stored', NEW.name;
        END IF;
    END IF;
    IF TG_OP <> 'INSERT' AND OLD.vocabulary IS NOT NULL THEN
        UPDATE blobs SET needed = needed - 1 WHERE digest = OLD.vocabulary;
    END IF;
    RETURN NULL;
END
$$;

CREATE TRIGGER vocabulary_counted AFTER INSERT OR DELETE OR UPDATE OF vocabulary ON maps
    FOR EACH ROW EXECUTE FUNCTION count_vocabulary();
