-- Version 6: the texts that were read in images.

CREATE TABLE image_texts (
    map_uid uuid NOT NULL,
    image text COLLATE "C" NOT NULL,
    -- SHA-256 of what read it.
    reader bytea NOT NULL,
    -- Whether it could not be read.
    failed boolean NOT NULL,
    lines integer NOT NULL,
    -- Hashes of the pairs of characters in the texts, by which a search finds the image. No extension is needed for
    -- them.
    grams integer[] NOT NULL,
    record json NOT NULL,
    PRIMARY KEY (map_uid, image),
    -- Removed with the image, also by a server of the previous version.
    FOREIGN KEY (map_uid, image) REFERENCES images (map_uid, id) ON DELETE CASCADE
);

CREATE INDEX image_texts_grams ON image_texts USING gin (grams);
