//! Small mutations of valid inputs, like those of coverage-guided fuzzers, without the coverage.

/// Numbers at which sizes and offsets often overflow.
const EDGES: [u64; 12] = [
    0,
    1,
    0x7f,
    0x80,
    0xff,
    0x7fff,
    0x8000,
    0xffff,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    u64::MAX,
];

/// Tokens that often break text parsers.
const WORDS: [&str; 14] = [
    "-1",
    "NaN",
    "1e999",
    "99999999999999999999",
    "\"",
    "{",
    "]",
    ",",
    "\n",
    "\0",
    "\u{202e}",
    "../",
    "null",
    "\u{feff}",
];

/// The largest input.
const MAX_BYTES: usize = 1 << 16;

/// Generates mutations of some inputs.
pub struct Mutator {
    state: u64,
    seeds: Vec<Vec<u8>>,
}

impl Mutator {
    pub fn new(seed: u64, seeds: Vec<Vec<u8>>) -> Self {
        Self { state: seed, seeds }
    }

    /// SplitMix64 (Steele, Lea and Flood, 2014).
    fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.state ^ (self.state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    fn below(&mut self, bound: usize) -> usize {
        (self.bits() % bound.max(1) as u64) as usize
    }

    /// One input with one to eight mutations.
    pub fn next_input(&mut self) -> Vec<u8> {
        let seed = self.below(self.seeds.len());
        let mut input = self.seeds[seed].clone();
        for _ in 0..=self.below(8) {
            self.damage(&mut input);
        }
        input.truncate(MAX_BYTES);
        input
    }

    fn range(&mut self, input: &[u8]) -> std::ops::Range<usize> {
        let start = self.below(input.len() + 1);
        let length = self.below(64).min(input.len() - start);
        start..start + length
    }

    fn damage(&mut self, input: &mut Vec<u8>) {
        let at = self.below(input.len());
        match self.below(10) {
            0 | 1 if !input.is_empty() => input[at] ^= 1 << self.below(8),
            2 if !input.is_empty() => input[at] = self.bits() as u8,
            3 | 4 => {
                // A number of 1, 2, 4 or 8 bytes, in either order.
                let width = 1 << self.below(4);
                let edge = EDGES[self.below(EDGES.len())];
                let mut bytes = edge.to_le_bytes()[..width].to_vec();
                if self.below(2) == 0 {
                    bytes.reverse();
                }
                let end = (at + width).min(input.len());
                input[at..end].copy_from_slice(&bytes[..end - at]);
            }
            5 => {
                let range = self.range(input);
                input.drain(range);
            }
            6 => {
                let copied = self.range(input);
                let copied = input[copied].to_vec();
                input.splice(at..at, copied);
            }
            7 => {
                let word = WORDS[self.below(WORDS.len())];
                input.splice(at..at, word.bytes());
            }
            8 => {
                let other = self.below(self.seeds.len());
                let from = self.below(self.seeds[other].len());
                input.truncate(at);
                input.extend_from_slice(&self.seeds[other][from..]);
            }
            _ => input.truncate(at),
        }
    }
}
