//! A graph that is finished: no point comes to it any more.
//!
//! Its neighbours are rows of flat arrays, the points that a search has seen a bitmap, and its
//! descriptors 8-bit codes beside one another. The best are scored again with the stored descriptors,
//! so that what is returned is exact.

use super::codes::{Coded, Codes, Ranked};
use super::exact::Best;
use super::layer::Layer;
use super::{Found, IndexSettings, Vectors};
use crate::domain::dot;

/// What a file begins with; the last byte is its version.
const MAGIC: [u8; 8] = *b"WBGRAPH2";
/// Magic and the checksum of the rest.
const HEADER_BYTES: usize = 8 + 4;

/// Points that are kept in view on the way down through the upper layers.
pub(super) const DESCENT: usize = 8;

/// A finished graph over the slots below [`SealedGraph::end`].
#[derive(Debug, PartialEq)]
pub struct SealedGraph {
    /// How it was built: M and efConstruction.
    built: (usize, usize),
    /// Slots from here on are not in it.
    end: usize,
    /// Point → slot.
    slots: Vec<u32>,
    /// The lowest first; there is always one.
    layers: Vec<Layer<u32>>,
    codes: Codes,
}

/// A file that holds no graph of this kind.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("the graph's file is damaged or of another version")]
pub struct DamagedGraph;

impl SealedGraph {
    pub(super) fn new(
        built: (usize, usize),
        end: usize,
        slots: Vec<u32>,
        layers: Vec<Layer<u32>>,
        codes: Codes,
    ) -> Self {
        Self { built, end, slots, layers, codes }
    }

    /// Slots from here on are not in the graph.
    pub fn end(&self) -> usize {
        self.end
    }

    /// Whether it was built as these settings say.
    pub fn fits(&self, settings: &IndexSettings) -> bool {
        self.built == (settings.m, settings.ef_construction)
    }

    /// Numbers in each descriptor.
    pub fn dim(&self) -> usize {
        self.codes.dim
    }

    /// Bytes of its arrays.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.slots[..])
            + self.layers.iter().map(|layer| size_of_val(&layer.cells[..])).sum::<usize>()
            + size_of_val(&self.codes.codes[..])
            + size_of_val(&self.codes.scales[..])
    }

    /// Points in the graph.
    pub fn len(&self) -> usize {
        self.slots.len()
    }

    /// Whether there is no point in the graph.
    pub fn is_empty(&self) -> bool {
        self.slots.is_empty()
    }

    /// The `k` nearest that `keep` lets through, scored with the stored descriptors.
    pub(super) fn search(
        &self,
        vectors: &dyn Vectors,
        query: &[f32],
        (k, ef): (usize, usize),
        keep: impl Fn(usize) -> bool,
    ) -> Vec<Found> {
        if self.is_empty() || query.len() != self.dim() {
            return Vec::new();
        }
        let mut coded = Codes::new(self.dim(), 1);
        coded.push(query);
        // Codes are right to about a hundredth: a few more than k hold the k best.
        let mut best = Best::new(k);
        for ranked in self.near(coded.of(0), ef, keep).into_iter().take(2 * k + 16) {
            let slot = self.slots[ranked.point() as usize] as usize;
            vectors.scan(slot..slot + 1, &mut |slot, vector| {
                best.offer(Found { slot, similarity: dot(query, vector) });
            });
        }
        best.into_sorted()
    }

    /// The `ef` nearest points that `keep` lets through, the nearest first.
    fn near(&self, query: Coded<'_>, ef: usize, keep: impl Fn(usize) -> bool) -> Vec<Ranked> {
        let mut near = vec![self.codes.ranked(query, 0)];
        for layer in self.layers[1..].iter().rev() {
            near = layer.beam(&self.codes, query, &near, DESCENT, |_| true);
        }
        let kept = |point: u32| keep(self.slots[point as usize] as usize);
        self.layers[0].beam(&self.codes, query, &near, ef, kept)
    }

    /// The graph as a file holds it: a header with a checksum, then the arrays, little-endian.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEADER_BYTES + self.bytes() + 64);
        bytes.extend(MAGIC);
        bytes.extend([0; 4]);
        let (m, ef_construction) = self.built;
        let counts = [m, ef_construction, self.end, self.dim(), self.len(), self.layers.len()];
        counts.into_iter().for_each(|count| put(&mut bytes, count as u32));
        self.slots.iter().for_each(|slot| put(&mut bytes, *slot));
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
        // What follows is what was written: the checksum says so.
        let mut reader = Reader(rest);
        let [m, ef_construction, end, dim, len, layers] = reader.counts()?;
        let slots = reader.numbers(len)?;
        let layers = (0..layers)
            .map(|_| {
                let [degree, points] = reader.counts()?;
                Ok(Layer { degree, cells: reader.numbers(points * degree)? })
            })
            .collect::<Result<_, _>>()?;
        let scales = reader.numbers(len)?.into_iter().map(f32::from_bits).collect();
        let codes = bytemuck::cast_slice(reader.take(len * dim)?).to_vec();
        let codes = Codes { dim, codes, scales };
        Ok(Self { built: (m, ef_construction), end, slots, layers, codes })
    }
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
        let (numbers, _) = self.take(count * 4)?.as_chunks::<4>();
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
