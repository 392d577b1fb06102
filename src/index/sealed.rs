//! A sealed graph: built by `hnsw_rs`, converted to a read-only layout, and searched here.
//!
//! In a growing graph, each point holds reference-counted links to its neighbours, and a search keeps a hash map of
//! visited points. A read-only graph can do with less: neighbours are rows of a flat array, visited points are a
//! bitmap, and descriptors are contiguous 8-bit codes, a quarter of the memory traffic per comparison. The best
//! candidates are scored again with the stored descriptors, so the returned similarities are exact.
//!
//! The search is that of Malkov and Yashunin (2018): descend greedily through the upper layers, then run a beam
//! search of width `ef` in the lowest one.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use multiversion::multiversion;

use super::exact::TopK;
use super::graph::Linked;
use super::{IndexSettings, ScoredSlot, Vectors};
use whereabouts_core::dot;

/// Padding of neighbour rows.
const NONE: u32 = u32::MAX;

/// Magic bytes of a graph file; the last byte is the version.
const MAGIC: [u8; 8] = *b"WBGRAPH1";
/// Size of the magic bytes and the checksum.
const HEADER_BYTES: usize = 8 + 4;

/// A read-only graph over the slots below [`SealedGraph::end`].
#[derive(Debug, PartialEq)]
pub struct SealedGraph {
    /// M and ef_construction with which the graph was built.
    built: (usize, usize),
    /// Slots from here on are not in the graph.
    end: usize,
    dim: usize,
    /// Slot of each point.
    slots: Vec<u32>,
    /// Neighbours of each point in the lowest layer, in rows of `degree`, padded with [`NONE`].
    lowest: Vec<u32>,
    degree: usize,
    /// The upper layers, highest first.
    upper: Vec<Layer>,
    /// 8-bit codes of each point's descriptor, `dim` per point.
    codes: Vec<i8>,
    /// Quantisation step of each point's codes.
    scales: Vec<f32>,
}

/// An upper layer, which contains few of the points.
#[derive(Debug, Default, PartialEq)]
struct Layer {
    /// Points of the layer, sorted.
    points: Vec<u32>,
    /// Start of each point's neighbours in `neighbours`, followed by the end of the last.
    starts: Vec<u32>,
    neighbours: Vec<u32>,
}

impl Layer {
    fn neighbours_of(&self, point: u32) -> &[u32] {
        let Ok(index) = self.points.binary_search(&point) else { return &[] };
        &self.neighbours[self.starts[index] as usize..self.starts[index + 1] as usize]
    }
}

/// The file is not a valid graph.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("the graph file is damaged or of another version")]
pub struct DamagedGraph;

/// A descriptor quantised to 8-bit codes.
struct Quantised<'a> {
    codes: &'a [i8],
    scale: f32,
}

/// Appends the 8-bit codes of a vector to `into` and returns their quantisation step.
fn quantise(vector: &[f32], into: &mut Vec<i8>) -> f32 {
    let largest = vector.iter().fold(f32::MIN_POSITIVE, |max, x| max.max(x.abs()));
    let scale = largest / 127.0;
    // `round` rounds half away from zero; the codes are within −127..=127.
    into.extend(vector.iter().map(|x| (x / scale).round() as i8));
    scale
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn coded_dot(a: &[i8], b: &[i8]) -> i32 {
    let length = a.len().min(b.len());
    let (a, b) = (&a[..length], &b[..length]);
    let mut sum = 0;
    // Indices, because iterator adapters are not always inlined into a multiversioned function.
    for index in 0..length {
        sum += i32::from(a[index]) * i32::from(b[index]);
    }
    sum
}

/// Packs a similarity and a point into an integer that sorts by similarity.
fn ranked(similarity: f32, point: u32) -> u64 {
    let bits = similarity.to_bits();
    let ordered = if bits >> 31 == 0 { bits | 1 << 31 } else { !bits };
    u64::from(ordered) << 32 | u64::from(point)
}

fn point_of(ranked: u64) -> u32 {
    ranked as u32
}

impl SealedGraph {
    /// Converts a grown graph that covers the slots below `end`. `linked` are its points with their links, and
    /// `vectors` their descriptors.
    pub(super) fn new(
        linked: &[Linked],
        end: usize,
        vectors: &dyn Vectors,
        settings: &IndexSettings,
    ) -> Self {
        let mut point_of_slot = vec![NONE; end];
        for (point, linked) in linked.iter().enumerate() {
            point_of_slot[linked.slot] = point as u32;
        }
        let points = |slots: &[usize]| -> Vec<u32> {
            let known = slots.iter().filter_map(|slot| point_of_slot.get(*slot).copied());
            known.filter(|point| *point != NONE).collect()
        };
        let degree = linked.iter().filter_map(|linked| linked.layers.first()).map(Vec::len).max();
        let degree = degree.unwrap_or(0).max(1);
        let mut lowest = vec![NONE; linked.len() * degree];
        for (row, linked) in lowest.chunks_exact_mut(degree).zip(linked) {
            let neighbours = linked.layers.first().map_or(Vec::new(), |slots| points(slots));
            row.iter_mut().zip(neighbours).for_each(|(entry, neighbour)| *entry = neighbour);
        }
        let highest = linked.iter().map(|linked| linked.layers.len()).max().unwrap_or(0);
        let layer = |level: usize| {
            let mut layer = Layer::default();
            for (point, linked) in linked.iter().enumerate() {
                if let Some(slots) = linked.layers.get(level) {
                    layer.points.push(point as u32);
                    layer.starts.push(layer.neighbours.len() as u32);
                    layer.neighbours.extend(points(slots));
                }
            }
            layer.starts.push(layer.neighbours.len() as u32);
            layer
        };
        let upper = (1..highest).rev().map(layer).collect();
        let dim = vectors.dim();
        let mut codes = Vec::with_capacity(linked.len() * dim);
        let mut scales = Vec::with_capacity(linked.len());
        for (point, linked) in linked.iter().enumerate() {
            vectors.scan(linked.slot..linked.slot + 1, &mut |_, vector| {
                scales.push(quantise(vector, &mut codes));
            });
            if scales.len() == point {
                // The descriptor has been removed. The point stays, because it links its neighbours.
                scales.push(0.0);
                codes.resize(codes.len() + dim, 0);
            }
        }
        let slots = linked.iter().map(|linked| linked.slot as u32).collect();
        let built = (settings.m, settings.ef_construction);
        Self { built, end, dim, slots, lowest, degree, upper, codes, scales }
    }

    /// Slots from here on are not in the graph.
    pub fn end(&self) -> usize {
        self.end
    }

    /// Whether the graph was built with these settings.
    pub fn is_built_with(&self, settings: &IndexSettings) -> bool {
        self.built == (settings.m, settings.ef_construction)
    }

    /// Numbers in each descriptor.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Size of the arrays in bytes.
    pub fn bytes(&self) -> usize {
        let of_layer = |layer: &Layer| {
            size_of_val(&layer.points[..])
                + size_of_val(&layer.starts[..])
                + size_of_val(&layer.neighbours[..])
        };
        size_of_val(&self.slots[..])
            + size_of_val(&self.lowest[..])
            + self.upper.iter().map(of_layer).sum::<usize>()
            + size_of_val(&self.codes[..])
            + size_of_val(&self.scales[..])
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.slots.len()
    }

    /// Whether the graph has no points.
    pub fn is_empty(&self) -> bool {
        self.slots.is_empty()
    }

    /// Returns the `k` nearest slots that pass `keep`, scored with the stored descriptors.
    pub(super) fn search(
        &self,
        vectors: &dyn Vectors,
        query: &[f32],
        (k, ef): (usize, usize),
        keep: impl Fn(usize) -> bool,
    ) -> Vec<ScoredSlot> {
        if self.is_empty() || query.len() != self.dim {
            return Vec::new();
        }
        let mut codes = Vec::with_capacity(self.dim);
        let scale = quantise(query, &mut codes);
        let near = self.beam_search(&Quantised { codes: &codes, scale }, ef, keep);
        // Quantised similarities are accurate to about 0.01, so slightly more than k candidates contain the k
        // best.
        let mut best = TopK::new(k);
        for ranked in near.into_iter().rev().take(2 * k + 16) {
            let slot = self.slots[point_of(ranked) as usize] as usize;
            vectors.scan(slot..slot + 1, &mut |slot, vector| {
                best.offer(ScoredSlot { slot, similarity: dot(query, vector) });
            });
        }
        best.into_sorted()
    }

    fn similarity(&self, query: &Quantised<'_>, point: u32) -> f32 {
        let point = point as usize;
        let codes = &self.codes[point * self.dim..(point + 1) * self.dim];
        coded_dot(query.codes, codes) as f32 * (query.scale * self.scales[point])
    }

    /// Descends greedily through the upper layers to the entry point of the lowest one.
    fn descend(&self, query: &Quantised<'_>) -> u64 {
        let entry = self.upper.first().and_then(|layer| layer.points.first()).copied();
        let entry = entry.unwrap_or(0);
        let mut best = ranked(self.similarity(query, entry), entry);
        for layer in &self.upper {
            loop {
                let nearer = layer
                    .neighbours_of(point_of(best))
                    .iter()
                    .map(|&point| ranked(self.similarity(query, point), point))
                    .max()
                    .filter(|nearer| *nearer > best);
                match nearer {
                    Some(nearer) => best = nearer,
                    None => break,
                }
            }
        }
        best
    }

    /// Returns the `ef` nearest points of the lowest layer that pass `keep`, farthest first.
    fn beam_search(
        &self,
        query: &Quantised<'_>,
        ef: usize,
        keep: impl Fn(usize) -> bool,
    ) -> Vec<u64> {
        let mut visited = vec![0_u64; self.len().div_ceil(64)];
        let mut visit = |point: u32| {
            let (word, bit) = (&mut visited[point as usize / 64], 1 << (point % 64));
            let new = *word & bit == 0;
            *word |= bit;
            new
        };
        let kept = |point: u32| keep(self.slots[point as usize] as usize);
        let entry = self.descend(query);
        visit(point_of(entry));
        let mut open = BinaryHeap::from([entry]);
        let mut best: BinaryHeap<Reverse<u64>> = BinaryHeap::with_capacity(ef + 1);
        if kept(point_of(entry)) {
            best.push(Reverse(entry));
        }
        let mut fresh = Vec::with_capacity(self.degree);
        while let Some(nearest) = open.pop() {
            let worst = best.peek().filter(|_| best.len() >= ef).map_or(0, |worst| worst.0);
            if nearest < worst {
                break;
            }
            let row = point_of(nearest) as usize * self.degree;
            fresh.clear();
            // Collect unvisited neighbours first, so that the memory accesses of the comparisons overlap.
            let neighbours = &self.lowest[row..row + self.degree];
            fresh.extend(
                neighbours.iter().copied().take_while(|p| *p != NONE).filter(|p| visit(*p)),
            );
            for &point in &fresh {
                let candidate = ranked(self.similarity(query, point), point);
                let worst = best.peek().filter(|_| best.len() >= ef).map_or(0, |worst| worst.0);
                if candidate > worst {
                    open.push(candidate);
                    if kept(point) {
                        best.push(Reverse(candidate));
                        if best.len() > ef {
                            best.pop();
                        }
                    }
                }
            }
        }
        best.into_sorted_vec().into_iter().rev().map(|Reverse(ranked)| ranked).collect()
    }

    /// Serializes the graph: a header with a checksum, then the arrays in little-endian order.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut rest = Vec::with_capacity(self.codes.len() + 4 * (self.lowest.len() + 4));
        let (m, ef_construction) = self.built;
        let counts = [m, ef_construction, self.end, self.dim, self.len(), self.degree];
        let counts = counts.into_iter().chain([self.upper.len(), self.codes.len()]);
        counts.for_each(|count| rest.extend((count as u32).to_le_bytes()));
        put(&mut rest, &self.slots);
        put(&mut rest, &self.lowest);
        for layer in &self.upper {
            for part in [&layer.points, &layer.starts, &layer.neighbours] {
                rest.extend((part.len() as u32).to_le_bytes());
                put(&mut rest, part);
            }
        }
        rest.extend(self.scales.iter().flat_map(|scale| scale.to_le_bytes()));
        rest.extend_from_slice(bytemuck::cast_slice(&self.codes));
        let mut bytes = Vec::with_capacity(HEADER_BYTES + rest.len());
        bytes.extend(MAGIC);
        bytes.extend(crc32fast::hash(&rest).to_le_bytes());
        bytes.append(&mut rest);
        bytes
    }

    /// Deserializes the output of [`SealedGraph::to_bytes`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DamagedGraph> {
        let rest = bytes.strip_prefix(&MAGIC).ok_or(DamagedGraph)?;
        let (checksum, rest) = rest.split_first_chunk::<4>().ok_or(DamagedGraph)?;
        if crc32fast::hash(rest) != u32::from_le_bytes(*checksum) {
            return Err(DamagedGraph);
        }
        // The checksum guarantees that the rest is what `to_bytes` wrote.
        let mut reader = Reader(rest);
        let [m, ef_construction, end, dim, len, degree, layers, codes] = reader.counts()?;
        let slots = reader.numbers(len)?;
        let lowest = reader.numbers(len * degree)?;
        let mut upper = Vec::with_capacity(layers.min(64));
        for _ in 0..layers {
            let mut part = || {
                let [count] = reader.counts()?;
                reader.numbers(count)
            };
            upper.push(Layer { points: part()?, starts: part()?, neighbours: part()? });
        }
        let scales = reader.numbers(len)?.into_iter().map(f32::from_bits).collect();
        let codes = bytemuck::cast_slice(reader.take(codes)?).to_vec();
        let built = (m, ef_construction);
        Ok(Self { built, end, dim, slots, lowest, degree, upper, codes, scales })
    }
}

fn put(bytes: &mut Vec<u8>, numbers: &[u32]) {
    bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
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

#[cfg(test)]
mod tests;
