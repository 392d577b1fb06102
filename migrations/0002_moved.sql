-- Version 2: how often poses of a map's images were changed, which makes its calibration obsolete.

ALTER TABLE image_counts ADD COLUMN moved bigint NOT NULL DEFAULT 0;
