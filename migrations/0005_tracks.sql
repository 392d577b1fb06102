-- Version 5: the tracks of robots, which any server continues; and the place of an image in a recording.

-- What the filter knows of a robot after its last frame. It changes with each frame and says nothing that the frames
-- that follow would not say again, so it is not logged: after a crash of the database, tracks start anew.
CREATE UNLOGGED TABLE tracks (
    map_uid uuid NOT NULL,
    -- Whose track it is: the id of an API key.
    owner text COLLATE "C" NOT NULL,
    id text COLLATE "C" NOT NULL,
    -- Grows with each frame. It begins at random, so that it tells a track from an earlier one of the same name.
    version bigint NOT NULL,
    frames bigint NOT NULL,
    written_at timestamptz NOT NULL,
    state bytea NOT NULL,
    PRIMARY KEY (map_uid, owner, id)
) WITH (fillfactor = 70);
-- It hardly gets smaller.
ALTER TABLE tracks ALTER COLUMN state SET STORAGE EXTERNAL;

-- The recording that an image belongs to, and its number there; null for images that were added by themselves.
ALTER TABLE images ADD COLUMN recording uuid, ADD COLUMN number bigint;

-- The changes that concern images with a pose, by which a server notices that a map has other paths.
ALTER TABLE image_counts ADD COLUMN located bigint NOT NULL DEFAULT 0;
