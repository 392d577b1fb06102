//! A finished graph: no point is added to it any more.
//!
//! Neighbours are rows of flat arrays, the visited set of a search is a bitmap, and descriptors are compared by 8-bit
//! codes. The best candidates are scored again with the stored descriptors, so that returned similarities are exact.
//!
//! Images with equal descriptors are one point with several slots.

use super::beam::Beam;
use super::codes::{Coded, Codes, Ranked};
use super::exact::TopK;
use super::layer::Layer;
use super::repair::reach;
use super::{IndexSettings, ScoredSlot, Vectors};
use whereabouts_core::dot;

/// The first bytes of a file; the last of them is its version.
const MAGIC: [u8; 8] = *b"WBGRAPH3";
/// Magic and the checksum of the rest.
const HEADER_BYTES: usize = 8 + 4;

/// Beam width of the descent through the upper layers.
pub(super) const DESCENT: usize = 8;

/// How often the beam of a search is doubled, while its result still changes or its candidates are too alike for their
/// codes.
pub(super) const WIDENINGS: usize = 3;

/// Up to this many points, comparing every code with that of the query takes no longer than a walk through the graph,
/// and misses nothing. Tests walk through every graph.
const SCANNED: Option<usize> = if cfg!(test) { None } else { Some(12_000) };

/// A finished graph over the slots below [`SealedGraph::end`].
#[derive(Debug, PartialEq)]
pub struct SealedGraph {
    /// The M and efConstruction that it was built with.
    built: (usize, usize),
    /// The first slot beyond the graph.
    end: usize,
    slots: Slots,
    /// The lowest first; there is always one.
    pub(super) layers: Vec<Layer<u32>>,
    pub(super) codes: Codes,
}

/// The slots of each point, ascending.
#[derive(Debug, PartialEq)]
pub(super) struct Slots {
    /// Point → where its slots start; one more at the end.
    starts: Vec<u32>,
    slots: Vec<u32>,
}

impl Slots {
    pub fn new<'a>(of_points: impl Iterator<Item = &'a [u32]>) -> Self {
        let (mut starts, mut slots) = (vec![0], Vec::new());
        for of_point in of_points {
            slots.extend_from_slice(of_point);
            starts.push(slots.len() as u32);
        }
        Self { starts, slots }
    }

    /// The number of points.
    pub fn points(&self) -> usize {
        self.starts.len() - 1
    }

    fn of(&self, point: u32) -> &[u32] {
        let point = point as usize;
        &self.slots[self.starts[point] as usize..self.starts[point + 1] as usize]
    }
}

/// A file that holds no graph of this kind.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("the graph's file is damaged or of another version")]
pub struct DamagedGraph;

impl SealedGraph {
    pub(super) fn new(
        built: (usize, usize),
        end: usize,
        slots: Slots,
        layers: Vec<Layer<u32>>,
        codes: Codes,
    ) -> Self {
        Self { built, end, slots, layers, codes }
    }

    /// The first slot beyond the graph.
    pub fn end(&self) -> usize {
        self.end
    }

    /// Whether it was built with these settings.
    pub fn is_built_with(&self, settings: &IndexSettings) -> bool {
        self.built == (settings.m, settings.ef_construction)
    }

    /// Numbers in each descriptor.
    pub fn dim(&self) -> usize {
        self.codes.dim
    }

    /// Bytes of its arrays.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.slots.starts[..])
            + size_of_val(&self.slots.slots[..])
            + self.layers.iter().map(|layer| size_of_val(&layer.cells[..])).sum::<usize>()
            + size_of_val(&self.codes.codes[..])
            + size_of_val(&self.codes.scales[..])
    }

    /// Slots in the graph.
    pub fn len(&self) -> usize {
        self.slots.slots.len()
    }

    /// Whether there is no slot in the graph.
    pub fn is_empty(&self) -> bool {
        self.slots.slots.is_empty()
    }

    /// Slots that no search can reach from the entry point. A graph that was built without an error has none.
    pub fn unreachable(&self) -> usize {
        let mut reached = vec![false; self.slots.points()];
        if !reached.is_empty() {
            reach(&self.layers[0], 0, &mut reached);
        }
        let lost = (0..reached.len()).filter(|&point| !reached[point]);
        lost.map(|point| self.slots.of(point as u32).len()).sum()
    }

    /// The `k` nearest slots that `keep` accepts, scored with the stored descriptors.
    pub(super) fn search(
        &self,
        vectors: &dyn Vectors,
        query: &[f32],
        (k, ef): (usize, usize),
        keep: impl Fn(usize) -> bool,
    ) -> Vec<ScoredSlot> {
        if self.is_empty() || query.len() != self.dim() {
            return Vec::new();
        }
        match SCANNED.is_some_and(|scanned| self.slots.points() <= scanned) {
            true => self.scan(vectors, query, (k, ef), keep),
            false => self.walk(vectors, query, (k, ef), keep),
        }
    }

    /// Searches with a beam from the entry point.
    fn walk(
        &self,
        vectors: &dyn Vectors,
        query: &[f32],
        (k, ef): (usize, usize),
        keep: impl Fn(usize) -> bool,
    ) -> Vec<ScoredSlot> {
        let coded = self.coded(query);
        let query_code = coded.of(0);
        let entries = descend(&self.layers, &self.codes, query_code);
        let kept = |point: u32| self.slots.of(point).iter().any(|&slot| keep(slot as usize));
        let layer = (&self.layers[0], &self.codes);
        let mut beam = Beam::new(layer, query_code, &entries, ef, kept).widening(k).run();
        let (mut ef, widest) = (ef, ef << WIDENINGS);
        loop {
            let is_last = beam.has_all() || ef >= widest;
            if is_last || beam.has_converged() {
                let near = beam.nearest();
                let (best, is_complete) =
                    self.rescored(vectors, query, query_code, &near, k, &keep);
                if is_last || is_complete {
                    return best;
                }
            }
            ef *= 2;
            beam = beam.widen(ef);
        }
    }

    /// Searches all points.
    pub(super) fn scan(
        &self,
        vectors: &dyn Vectors,
        query: &[f32],
        (k, ef): (usize, usize),
        keep: impl Fn(usize) -> bool,
    ) -> Vec<ScoredSlot> {
        let coded = self.coded(query);
        let query_code = coded.of(0);
        let kept = |point: &u32| self.slots.of(*point).iter().any(|&slot| keep(slot as usize));
        let points = (0..self.slots.points() as u32).filter(kept);
        let mut all: Vec<Ranked> =
            points.map(|point| self.codes.ranked(query_code, point)).collect();
        let mut wanted = ef;
        loop {
            let count = all.len();
            let is_last = wanted >= count;
            if !is_last {
                all.select_nth_unstable_by(wanted, |a, b| b.cmp(a));
            }
            let near = &mut all[..wanted.min(count)];
            near.sort_unstable_by(|a, b| b.cmp(a));
            let (best, is_complete) = self.rescored(vectors, query, query_code, near, k, &keep);
            if is_last || is_complete {
                return best;
            }
            wanted *= 2;
        }
    }

    /// The code of a query, as the only point.
    fn coded(&self, query: &[f32]) -> Codes {
        let mut coded = Codes::new(self.dim(), 1);
        coded.push(query);
        coded
    }

    /// Scores candidates with the stored descriptors. Among images that hardly differ the coded similarity says
    /// little, so scoring continues until no further candidate can be one of the `k` best; the second value tells
    /// whether it got there.
    fn rescored(
        &self,
        vectors: &dyn Vectors,
        query: &[f32],
        query_code: Coded<'_>,
        near: &[Ranked],
        k: usize,
        keep: impl Fn(usize) -> bool,
    ) -> (Vec<ScoredSlot>, bool) {
        // Bounds the work on a point with many slots; their similarities differ by less than the code tells.
        let per_point = 2 * k + 16;
        let mut best = TopK::new(k);
        for ranked in near {
            let margin = query_code.error(self.codes.of(ranked.point()));
            if best.worst().is_some_and(|worst| ranked.similarity() + margin < worst) {
                return (best.into_sorted(), true);
            }
            let kept = self.slots.of(ranked.point()).iter().map(|&slot| slot as usize);
            for slot in kept.filter(|&slot| keep(slot)).take(per_point) {
                vectors.scan(slot..slot + 1, &mut |slot, vector| {
                    best.offer(ScoredSlot { slot, similarity: dot(query, vector) });
                });
            }
        }
        (best.into_sorted(), false)
    }

    /// The graph as a file: a header with a checksum, then the arrays, little-endian.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEADER_BYTES + self.bytes() + 64);
        bytes.extend(MAGIC);
        bytes.extend([0; 4]);
        let (m, ef_construction) = self.built;
        let (len, points) = (self.len(), self.slots.points());
        let counts = [m, ef_construction, self.end, self.dim(), len, points, self.layers.len()];
        counts.into_iter().for_each(|count| put(&mut bytes, count as u32));
        self.slots.starts.iter().for_each(|start| put(&mut bytes, *start));
        self.slots.slots.iter().for_each(|slot| put(&mut bytes, *slot));
        for layer in &self.layers {
            put(&mut bytes, layer.degree as u32);
            put(&mut bytes, layer.points() as u32);
            layer.cells.iter().for_each(|cell| put(&mut bytes, *cell));
        }
        self.codes.scales.iter().for_each(|scale| put(&mut bytes, scale.to_bits()));
        bytes.extend_from_slice(bytemuck::cast_slice(&self.codes.codes));
        let checksum = crc32fast::hash(&bytes[HEADER_BYTES..]);
        bytes[MAGIC.len()..HEADER_BYTES].copy_from_slice(&checksum.to_le_bytes());
        bytes
    }

    /// Reads what [`SealedGraph::to_bytes`] wrote.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DamagedGraph> {
        let rest = bytes.strip_prefix(&MAGIC).ok_or(DamagedGraph)?;
        let (checksum, rest) = rest.split_first_chunk::<4>().ok_or(DamagedGraph)?;
        if crc32fast::hash(rest) != u32::from_le_bytes(*checksum) {
            return Err(DamagedGraph);
        }
        let mut reader = Reader(rest);
        let [m, ef_construction, end, dim, len, points, layers] = reader.counts()?;
        let slots = Slots { starts: reader.numbers(points + 1)?, slots: reader.numbers(len)? };
        let layers = (0..layers)
            .map(|_| {
                let [degree, points] = reader.counts()?;
                Ok(Layer { degree, cells: reader.numbers(points.saturating_mul(degree))? })
            })
            .collect::<Result<Vec<_>, _>>()?;
        let scales = reader.numbers(points)?.into_iter().map(f32::from_bits).collect();
        let codes = bytemuck::cast_slice(reader.take(points.saturating_mul(dim))?).to_vec();
        let codes = Codes { dim, codes, scales };
        let graph = Self { built: (m, ef_construction), end, slots, layers, codes };
        graph.is_sound().then_some(graph).ok_or(DamagedGraph)
    }

    /// Whether every number that is used as an index is within its bounds.
    fn is_sound(&self) -> bool {
        let Slots { starts, slots } = &self.slots;
        let points = self.slots.points();
        starts.is_sorted()
            && starts.last().is_some_and(|&last| last as usize == slots.len())
            && slots.iter().all(|&slot| (slot as usize) < self.end)
            && self.layers.first().is_some_and(|lowest| lowest.points() == points)
            && self.layers.iter().all(|layer| layer.is_within(points))
    }
}

/// The entry points of the lowest layer for a query: the best of the layer above.
pub(super) fn descend(layers: &[Layer<u32>], codes: &Codes, query: Coded<'_>) -> Vec<Ranked> {
    let mut near = vec![codes.ranked(query, 0)];
    for layer in layers[1..].iter().rev() {
        near = layer.beam(codes, query, &near, DESCENT, |_| true);
    }
    near
}

fn put(bytes: &mut Vec<u8>, number: u32) {
    bytes.extend(number.to_le_bytes());
}

struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self, bytes: usize) -> Result<&'a [u8], DamagedGraph> {
        let (taken, rest) = self.0.split_at_checked(bytes).ok_or(DamagedGraph)?;
        self.0 = rest;
        Ok(taken)
    }

    fn numbers(&mut self, count: usize) -> Result<Vec<u32>, DamagedGraph> {
        let (numbers, _) = self.take(count.saturating_mul(4))?.as_chunks::<4>();
        Ok(numbers.iter().copied().map(u32::from_le_bytes).collect())
    }

    fn counts<const N: usize>(&mut self) -> Result<[usize; N], DamagedGraph> {
        let counts = self.numbers(N)?;
        counts
            .iter()
            .map(|&count| count as usize)
            .collect::<Vec<_>>()
            .try_into()
            .map_err(|_| DamagedGraph)
    }
}
