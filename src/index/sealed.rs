//! A graph that is finished: `hnsw_rs` builds it, and this searches it.
//!
//! While a graph grows, each of its points holds counted references to its neighbours, and a search
//! keeps a hash map of the points it has seen. Once it is finished that freedom is not needed:
//! neighbours become rows of a flat array, the points seen a bitmap, and descriptors 8-bit codes
//! beside one another, a quarter of the bytes that a comparison has to fetch. The best are scored
//! again with the stored descriptors, so that what is returned is exact.
//!
//! The algorithm is that of Malkov and Yashunin (2018): descend greedily through the upper layers,
//! then search the lowest one with a queue of the `ef` best.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use multiversion::multiversion;

use super::exact::Best;
use super::graph::Linked;
use super::{IndexSettings, ScoredSlot, Vectors};
use whereabouts_core::dot;

/// Fills rows of neighbours that are shorter than the longest.
const NONE: u32 = u32::MAX;

/// What a file begins with; the last byte is its version.
const MAGIC: [u8; 8] = *b"WBGRAPH1";
/// Magic and the checksum of the rest.
const HEADER_BYTES: usize = 8 + 4;

/// A finished graph over the slots below [`SealedGraph::end`].
#[derive(Debug, PartialEq)]
pub struct SealedGraph {
    /// How it was built: M and efConstruction.
    built: (usize, usize),
    /// Slots from here on are not in it.
    end: usize,
    dim: usize,
    /// Point → slot.
    slots: Vec<u32>,
    /// The neighbours of each point in the lowest layer, in rows of `degree`.
    lowest: Vec<u32>,
    degree: usize,
    /// The layers above it, the highest first.
    upper: Vec<Layer>,
    /// Point → `dim` codes.
    codes: Vec<i8>,
    /// Point → what one step of its codes is worth.
    scales: Vec<f32>,
}

/// A layer of few points.
#[derive(Debug, Default, PartialEq)]
struct Layer {
    /// Its points, in order.
    points: Vec<u32>,
    /// Where the neighbours of each begin in `neighbours`, and the end.
    starts: Vec<u32>,
    neighbours: Vec<u32>,
}

impl Layer {
    fn of(&self, point: u32) -> &[u32] {
        let Ok(place) = self.points.binary_search(&point) else { return &[] };
        &self.neighbours[self.starts[place] as usize..self.starts[place + 1] as usize]
    }
}

/// A file that holds no graph of this kind.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("the graph's file is damaged or of another version")]
pub struct DamagedGraph;

/// A descriptor in 8-bit codes.
struct Coded<'a> {
    codes: &'a [i8],
    scale: f32,
}

fn code(vector: &[f32], into: &mut Vec<i8>) -> f32 {
    let largest = vector.iter().fold(f32::MIN_POSITIVE, |most, x| most.max(x.abs()));
    let scale = largest / 127.0;
    // Rounded away from zero at halves; the cast keeps within −127..=127.
    into.extend(vector.iter().map(|x| (x / scale).round() as i8));
    scale
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn coded_dot(a: &[i8], b: &[i8]) -> i32 {
    let length = a.len().min(b.len());
    let (a, b) = (&a[..length], &b[..length]);
    let mut sum = 0;
    // Indices, because adapters of iterators are not always compiled into their caller.
    for index in 0..length {
        sum += i32::from(a[index]) * i32::from(b[index]);
    }
    sum
}

/// Similarity and point in one number that sorts by similarity.
fn ranked(similarity: f32, point: u32) -> u64 {
    let bits = similarity.to_bits();
    let ordered = if bits >> 31 == 0 { bits | 1 << 31 } else { !bits };
    u64::from(ordered) << 32 | u64::from(point)
}

fn point_of(ranked: u64) -> u32 {
    ranked as u32
}

impl SealedGraph {
    /// Takes a grown graph apart. `linked` are its points with their neighbours, `vectors` their
    /// descriptors; it covers the slots below `end`.
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
            row.iter_mut().zip(neighbours).for_each(|(place, neighbour)| *place = neighbour);
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
                scales.push(code(vector, &mut codes));
            });
            if scales.len() == point {
                // Its row has gone. It is not part of the map then, but a way to its neighbours.
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

    /// Whether it was built as these settings say.
    pub fn is_built_with(&self, settings: &IndexSettings) -> bool {
        self.built == (settings.m, settings.ef_construction)
    }

    /// Numbers in each descriptor.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Bytes of its arrays.
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
    ) -> Vec<ScoredSlot> {
        if self.is_empty() || query.len() != self.dim {
            return Vec::new();
        }
        let mut codes = Vec::with_capacity(self.dim);
        let scale = code(query, &mut codes);
        let near = self.beam(&Coded { codes: &codes, scale }, ef, keep);
        // Codes are right to about a hundredth: a few more than k hold the k best.
        let mut best = Best::new(k);
        for ranked in near.into_iter().rev().take(2 * k + 16) {
            let slot = self.slots[point_of(ranked) as usize] as usize;
            vectors.scan(slot..slot + 1, &mut |slot, vector| {
                best.offer(ScoredSlot { slot, similarity: dot(query, vector) });
            });
        }
        best.into_sorted()
    }

    fn similarity(&self, query: &Coded<'_>, point: u32) -> f32 {
        let point = point as usize;
        let codes = &self.codes[point * self.dim..(point + 1) * self.dim];
        coded_dot(query.codes, codes) as f32 * (query.scale * self.scales[point])
    }

    /// Where the search of the lowest layer begins: the best that the upper layers lead to.
    fn descend(&self, query: &Coded<'_>) -> u64 {
        let entry = self.upper.first().and_then(|layer| layer.points.first()).copied();
        let entry = entry.unwrap_or(0);
        let mut best = ranked(self.similarity(query, entry), entry);
        for layer in &self.upper {
            loop {
                let nearer = layer
                    .of(point_of(best))
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

    /// The `ef` nearest of the lowest layer that `keep` lets through, the farthest first.
    fn beam(&self, query: &Coded<'_>, ef: usize, keep: impl Fn(usize) -> bool) -> Vec<u64> {
        let mut seen = vec![0_u64; self.len().div_ceil(64)];
        let mut see = |point: u32| {
            let (word, bit) = (&mut seen[point as usize / 64], 1 << (point % 64));
            let new = *word & bit == 0;
            *word |= bit;
            new
        };
        let kept = |point: u32| keep(self.slots[point as usize] as usize);
        let entry = self.descend(query);
        see(point_of(entry));
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
            // ScoredSlot first and compared afterwards, so that the fetches of codes overlap.
            let neighbours = &self.lowest[row..row + self.degree];
            fresh.extend(neighbours.iter().copied().take_while(|p| *p != NONE).filter(|p| see(*p)));
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

    /// The graph as a file holds it: a header with a checksum, then the arrays, little-endian.
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

    /// Reads what [`SealedGraph::to_bytes`] wrote.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DamagedGraph> {
        let rest = bytes.strip_prefix(&MAGIC).ok_or(DamagedGraph)?;
        let (checksum, rest) = rest.split_first_chunk::<4>().ok_or(DamagedGraph)?;
        if crc32fast::hash(rest) != u32::from_le_bytes(*checksum) {
            return Err(DamagedGraph);
        }
        // What follows is what was written: the checksum says so.
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
mod tests {
    use super::*;

    #[test]
    fn what_sorts_later_is_more_similar() {
        let similarities = [-1.0, -0.5, -0.0, 0.0, 1e-9, 0.5, 1.0];
        let ranks: Vec<u64> = similarities.iter().map(|&s| ranked(s, 7)).collect();
        assert!(ranks.is_sorted());
        assert_eq!(point_of(ranked(-0.3, 12)), 12);
    }

    #[test]
    fn codes_keep_a_similarity_to_about_a_hundredth() {
        let wave = |phase: f32| -> Vec<f32> {
            let wave: Vec<f32> = (0..384).map(|i| (i as f32 * 0.7 + phase).sin()).collect();
            let norm = wave.iter().map(|x| x * x).sum::<f32>().sqrt();
            wave.iter().map(|x| x / norm).collect()
        };
        let a = wave(0.0);
        for phase in [0.0, 0.3, 1.5, 3.0] {
            let b = wave(phase);
            let (mut ca, mut cb) = (Vec::new(), Vec::new());
            let (sa, sb) = (code(&a, &mut ca), code(&b, &mut cb));
            let coded = coded_dot(&ca, &cb) as f32 * sa * sb;
            assert!((coded - dot(&a, &b)).abs() < 0.01);
        }
    }
}
