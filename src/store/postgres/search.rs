//! The search in the descriptors of a map.
//!
//! A search through the index gets a few more images than requested, by their similarity in 16 bits, and ranks them
//! again at full precision. Of images that are equal in 16 bits the index contains the first only; the *twins* of what
//! it found are added (`migrations/0003_twins.sql`).
//!
//! Images that are nearly equal, as those of a robot that stands still, are a *crowd*: a search that gets among them may
//! end there, wherever the query belongs, because their neighbours are one another. One whose whole result is a crowd is
//! repeated with the widest beam, and if that holds nothing else either, all images are compared. `tests/store/search.rs`
//! checks the recall.

use sqlx::types::Json;
use sqlx::{AssertSqlSafe, Row};

use super::super::{HardNegatives, StoreError};
use super::descriptors::{descriptor_of, table};
use super::{Inner, count};
use whereabouts_core::{CalibrationSettings, Candidate, Descriptor, ImageId, Map, Pose};
use whereabouts_index::{ALIKE, SearchMode};

/// Number of images requested from the index in addition to `k`, to be ranked again.
const OVERFETCH: usize = 8;

/// The widest beam of pgvector.
const WIDEST: usize = 1000;

/// Images that are nearer to one another than this share of their distance from the query are a crowd, as are those that
/// are nearly equal.
const CROWD_SHARE: f32 = 0.25;

/// An image that a search found.
struct Found {
    slot: i64,
    id: ImageId,
    pose: Option<Pose>,
    similarity: f64,
}

/// The result of a search.
struct Nearest {
    /// The best first.
    found: Vec<Found>,
    /// Whether the beam holds one crowd only.
    is_crowd: bool,
}

impl Inner {
    /// Whether the map has an index.
    async fn has_graph(&self, map: &Map) -> Result<bool, StoreError> {
        if self.graphs.has(map) {
            return Ok(true);
        }
        let graph = sqlx::query_scalar(
            "SELECT coalesce(indexed_revision = revision, false) FROM maps
             WHERE uid = $1 AND revision = $2",
        )
        .bind(map.uid)
        .bind(i64::from(map.revision));
        let graph: Option<bool> = graph.fetch_optional(&self.pool).await?;
        if graph == Some(true) {
            self.graphs.add(map);
        }
        Ok(graph == Some(true))
    }

    pub(super) async fn candidates(
        &self,
        map: &Map,
        query: &Descriptor,
        k: usize,
        mode: SearchMode,
    ) -> Result<Vec<Candidate>, StoreError> {
        Ok(candidates(self.find(map, query, k, mode).await?))
    }

    /// Searches through the index, if the map has one and its answer can be trusted.
    async fn find(
        &self,
        map: &Map,
        query: &Descriptor,
        k: usize,
        mode: SearchMode,
    ) -> Result<Vec<Found>, StoreError> {
        if mode == SearchMode::Fast && self.has_graph(map).await? {
            for beam in [k + OVERFETCH, WIDEST.max(k + OVERFETCH)] {
                let nearest = self.nearest(map, query, k, Some(beam)).await?;
                // If many images were removed, an index scan may end before it has found enough.
                if nearest.found.len() < k {
                    break;
                }
                if !nearest.is_crowd {
                    return Ok(nearest.found);
                }
            }
        }
        Ok(self.nearest(map, query, k, None).await?.found)
    }

    /// Searches among the `beam` nearest of the index, or among all images.
    async fn nearest(
        &self,
        map: &Map,
        query: &Descriptor,
        k: usize,
        beam: Option<usize>,
    ) -> Result<Nearest, StoreError> {
        let (table, dim) = (table(map.uid, map.revision), map.dim);
        // OFFSET 0 makes the planner look up rows one by one; a generic plan would read all of the map's.
        let nearest = match beam {
            Some(_) => format!(
                "WITH beam AS MATERIALIZED (
                     SELECT slot, descriptor, descriptor <=> $1::real[]::vector AS distance
                     FROM {table} WHERE NOT twin
                     ORDER BY descriptor::halfvec({dim}) <=> $1::real[]::halfvec({dim}) LIMIT $6),
                 firsts AS MATERIALIZED (SELECT * FROM beam ORDER BY distance, slot LIMIT $5),
                 crowd AS MATERIALIZED (
                     SELECT max(beam.descriptor <=> nearest.descriptor)
                         < greatest({CROWD_SHARE} * min(nearest.distance), {ALIKE}) AS is_crowd
                     FROM beam, (SELECT * FROM firsts ORDER BY distance, slot LIMIT 1) nearest)
                 SELECT slot, distance, is_crowd FROM firsts, crowd
                 UNION ALL
                 SELECT twins.slot, twins.descriptor <=> $1::real[]::vector, is_crowd
                 FROM firsts JOIN LATERAL (
                     SELECT slot, descriptor FROM {table}
                     WHERE descriptor_code(descriptor) = descriptor_code(firsts.descriptor) AND twin
                     OFFSET 0) twins ON true, crowd"
            ),
            None => format!(
                "SELECT slot, descriptor <=> $1::real[]::vector AS distance, false AS is_crowd FROM {table}"
            ),
        };
        let sql = format!(
            "SELECT n.slot, i.id, i.pose, 1 - n.distance AS similarity, n.is_crowd
             FROM (SELECT slot, distance, is_crowd FROM ({nearest}) nearest
                   ORDER BY distance, slot LIMIT $2) n
             JOIN LATERAL (SELECT id, pose FROM images
                           WHERE map_uid = $3 AND slot = n.slot OFFSET 0) i ON true
             JOIN maps m ON m.uid = $3 AND m.revision = $4
             ORDER BY n.distance, n.slot"
        );
        let search = sqlx::query(AssertSqlSafe(sql))
            .bind(query.as_slice())
            .bind(count(k))
            .bind(map.uid)
            .bind(i64::from(map.revision));
        let rows = match beam {
            None => search.fetch_all(&self.pool).await,
            Some(beam) => {
                let search = search.bind(count(k + OVERFETCH)).bind(count(beam));
                if beam > self.settings.index.ef_search {
                    let mut tx = self.begin().await?;
                    // Raise ef_search for this search only.
                    sqlx::query("SELECT set_config('hnsw.ef_search', $1, true)")
                        .bind(beam.min(WIDEST).to_string())
                        .execute(&mut *tx)
                        .await?;
                    search.fetch_all(&mut *tx).await
                } else {
                    search.fetch_all(&self.pool).await
                }
            }
        };
        let rows = match rows {
            Ok(rows) => rows,
            Err(error) => return Err(self.explain(map, error).await),
        };
        if rows.is_empty() {
            self.check_revision(map).await?;
        }
        let is_crowd = rows.first().map(|row| row.try_get("is_crowd")).transpose()?;
        let found = rows.into_iter().map(|row| {
            let pose: Option<Json<Pose>> = row.try_get("pose")?;
            Ok(Found {
                slot: row.try_get("slot")?,
                id: image_id(row.try_get("id")?)?,
                pose: pose.map(|Json(pose)| pose),
                similarity: row.try_get("similarity")?,
            })
        });
        let found = found.collect::<Result<_, StoreError>>()?;
        Ok(Nearest { found, is_crowd: is_crowd.unwrap_or_default() })
    }

    /// Samples images evenly across the map and returns the `k` hardest negatives of each.
    pub(super) async fn find_hard_negatives(
        &self,
        map: &Map,
        settings: CalibrationSettings,
        k: usize,
    ) -> Result<Vec<HardNegatives>, StoreError> {
        let images: Vec<(i64, String, Option<Json<Pose>>)> =
            sqlx::query_as("SELECT slot, id, pose FROM images WHERE map_uid = $1 ORDER BY slot")
                .bind(map.uid)
                .fetch_all(&self.pool)
                .await?;
        let mut samples = Vec::new();
        for at in (0..images.len()).step_by(settings.step(images.len())) {
            let (slot, id, pose) = &images[at];
            let Some(descriptor) = self.descriptor(map, *slot).await? else { continue };
            let pose = pose.as_ref().map(|Json(pose)| *pose);
            let of_another_place = |found: &Found| {
                let position = images.partition_point(|(slot, ..)| *slot < found.slot);
                settings.are_apart(images.len(), (at, pose), (position, found.pose))
            };
            // Double the limit until enough results are of other places.
            let mut limit = k + 2 * settings.place_radius(images.len()) + 1;
            let others = loop {
                let found = self.find(map, &descriptor, limit, SearchMode::Fast).await?;
                let exhausted = found.len() < limit;
                let others: Vec<Found> =
                    found.into_iter().filter(of_another_place).take(k).collect();
                if others.len() == k || exhausted {
                    break others;
                }
                limit *= 2;
            };
            let image_id = image_id(id.clone())?;
            samples.push(HardNegatives { image_id, others: candidates(others) });
        }
        Ok(samples)
    }

    /// The descriptors in some slots.
    pub(super) async fn descriptors_in(
        &self,
        map: &Map,
        slots: &[usize],
    ) -> Result<Vec<Option<Descriptor>>, StoreError> {
        let table = table(map.uid, map.revision);
        let sql = format!(
            "SELECT d.descriptor::real[] FROM unnest($1) WITH ORDINALITY wanted (slot, place)
             LEFT JOIN {table} d USING (slot) ORDER BY wanted.place"
        );
        let slots: Vec<i64> = slots.iter().map(|slot| count(*slot)).collect();
        let found = sqlx::query_scalar(AssertSqlSafe(sql)).bind(slots).fetch_all(&self.pool).await;
        match found {
            Ok(found) => {
                let numbers = found.into_iter().map(|numbers: Option<Vec<f32>>| numbers);
                Ok(numbers.map(|numbers| numbers.and_then(descriptor_of)).collect())
            }
            Err(error) => Err(self.explain(map, error).await),
        }
    }

    /// The dot products of a vector and the descriptors in some slots.
    pub(super) async fn similarities_to(
        &self,
        map: &Map,
        vector: &[f32],
        slots: &[usize],
    ) -> Result<Vec<Option<f32>>, StoreError> {
        if slots.is_empty() {
            // The vector may be empty, too, which pgvector has none of.
            return Ok(Vec::new());
        }
        let table = table(map.uid, map.revision);
        // <#> is the negative dot product.
        let sql = format!(
            "SELECT (-(d.descriptor <#> $2::real[]::vector))::real
             FROM unnest($1) WITH ORDINALITY wanted (slot, place)
             LEFT JOIN {table} d USING (slot) ORDER BY wanted.place"
        );
        let slots: Vec<i64> = slots.iter().map(|slot| count(*slot)).collect();
        let found = sqlx::query_scalar(AssertSqlSafe(sql)).bind(slots).bind(vector);
        match found.fetch_all(&self.pool).await {
            Ok(found) => Ok(found),
            Err(error) => Err(self.explain(map, error).await),
        }
    }

    async fn descriptor(&self, map: &Map, slot: i64) -> Result<Option<Descriptor>, StoreError> {
        let table = table(map.uid, map.revision);
        let sql = format!("SELECT descriptor::real[] FROM {table} WHERE slot = $1");
        let found = sqlx::query_scalar(AssertSqlSafe(sql)).bind(slot);
        match found.fetch_optional(&self.pool).await {
            Ok(numbers) => Ok(numbers.and_then(descriptor_of)),
            Err(error) => Err(self.explain(map, error).await),
        }
    }
}

pub(super) fn image_id(id: String) -> Result<ImageId, StoreError> {
    id.parse().map_err(|_| {
        StoreError::Damaged("a stored image has an invalid id; restore a backup".into())
    })
}

fn candidates(found: Vec<Found>) -> Vec<Candidate> {
    let candidate = |(position, found): (usize, Found)| Candidate {
        rank: position + 1,
        image_id: found.id,
        // Rounding can push the cosine of identical pictures slightly above 1.
        similarity: (found.similarity as f32).clamp(-1.0, 1.0),
        pose: found.pose,
        order: usize::try_from(found.slot).ok(),
    };
    found.into_iter().enumerate().map(candidate).collect()
}
