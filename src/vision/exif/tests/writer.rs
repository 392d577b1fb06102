//! Writes EXIF data and the containers around it, as cameras and taggers do.

pub(super) const BYTE: u16 = 1;
pub(super) const ASCII: u16 = 2;
pub(super) const SHORT: u16 = 3;
pub(super) const LONG: u16 = 4;
pub(super) const RATIONAL: u16 = 5;
pub(super) const UNDEFINED: u16 = 7;
pub(super) const SRATIONAL: u16 = 10;
pub(super) const FLOAT: u16 = 11;
pub(super) const DOUBLE: u16 = 12;

/// A value of a field.
#[derive(Clone)]
pub(super) enum Raw {
    Text(u16, &'static [u8]),
    Bytes(u16, Vec<u8>),
    Shorts(Vec<u16>),
    Longs(Vec<u32>),
    Fractions(Vec<(u32, u32)>),
    Signed(Vec<(i32, i32)>),
    Floats(Vec<f32>),
    Doubles(Vec<f64>),
}

/// What follows the entries of a directory.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Next {
    Zero,
    /// piexif and its like write none.
    Absent,
    /// FLIR cameras write −1.
    MinusOne,
}

#[derive(Clone)]
pub(super) struct Writer {
    pub(super) is_big_endian: bool,
    pub(super) next: Next,
    pub(super) gps: Vec<(u16, Raw)>,
}

impl Writer {
    pub(super) fn new(gps: Vec<(u16, Raw)>) -> Self {
        Self { is_big_endian: false, next: Next::Zero, gps }
    }

    fn u16(&self, value: u16) -> [u8; 2] {
        if self.is_big_endian { value.to_be_bytes() } else { value.to_le_bytes() }
    }

    fn u32(&self, value: u32) -> [u8; 4] {
        if self.is_big_endian { value.to_be_bytes() } else { value.to_le_bytes() }
    }

    fn value(&self, raw: &Raw) -> (u16, u32, Vec<u8>) {
        let pairs = |pairs: Vec<(u32, u32)>| -> Vec<u8> {
            pairs.iter().flat_map(|&(a, b)| [self.u32(a), self.u32(b)].concat()).collect()
        };
        match raw {
            Raw::Text(kind, text) => (*kind, text.len() as u32, text.to_vec()),
            Raw::Bytes(kind, bytes) => (*kind, bytes.len() as u32, bytes.clone()),
            Raw::Shorts(all) => {
                (SHORT, all.len() as u32, all.iter().flat_map(|&one| self.u16(one)).collect())
            }
            Raw::Longs(all) => {
                (LONG, all.len() as u32, all.iter().flat_map(|&one| self.u32(one)).collect())
            }
            Raw::Fractions(all) => (RATIONAL, all.len() as u32, pairs(all.clone())),
            Raw::Signed(all) => {
                let all: Vec<_> =
                    all.iter().map(|&(a, b)| (a.cast_unsigned(), b.cast_unsigned())).collect();
                (SRATIONAL, all.len() as u32, pairs(all))
            }
            Raw::Floats(all) => {
                let bits = all.iter().flat_map(|one| self.u32(one.to_bits()));
                (FLOAT, all.len() as u32, bits.collect())
            }
            Raw::Doubles(all) => {
                let of = |one: &f64| match self.is_big_endian {
                    true => one.to_be_bytes(),
                    false => one.to_le_bytes(),
                };
                (DOUBLE, all.len() as u32, all.iter().flat_map(of).collect())
            }
        }
    }

    /// A directory at an offset, with the values behind it.
    pub(super) fn directory(&self, at: usize, fields: &[(u16, Raw)]) -> Vec<u8> {
        let next: &[u8] = match self.next {
            Next::Zero => &[0; 4],
            Next::Absent => &[],
            Next::MinusOne => &[0xFF; 4],
        };
        let mut head = self.u16(fields.len() as u16).to_vec();
        let mut values: Vec<u8> = Vec::new();
        let values_at = at + 2 + 12 * fields.len() + next.len();
        for (tag, raw) in fields {
            let (kind, count, bytes) = self.value(raw);
            head.extend([self.u16(*tag), self.u16(kind)].concat());
            head.extend(self.u32(count));
            if bytes.len() <= 4 {
                head.extend(bytes.iter().copied().chain([0; 4]).take(4));
            } else {
                head.extend(self.u32((values_at + values.len()) as u32));
                values.extend(bytes);
            }
        }
        [head, next.to_vec(), values].concat()
    }

    pub(super) fn tiff(&self) -> Vec<u8> {
        let magic: &[u8] = if self.is_big_endian { b"MM\0*" } else { b"II*\0" };
        let length = 2 + 12 + if self.next == Next::Absent { 0 } else { 4 };
        let pointer = Raw::Longs(vec![8 + length as u32]);
        let first = self.directory(8, &[(0x8825, pointer)]);
        let gps = self.directory(8 + length, &self.gps);
        [magic, &self.u32(8), &first, &gps].concat()
    }
}

pub(super) fn segment(marker: u8, data: &[u8]) -> Vec<u8> {
    [&[0xFF, marker][..], &((data.len() + 2) as u16).to_be_bytes(), data].concat()
}

pub(super) fn app1(tiff: &[u8]) -> Vec<u8> {
    segment(0xE1, &[b"Exif\0\0", tiff].concat())
}

/// A JPEG with these segments, up to its first scan.
pub(super) fn jpeg(segments: &[Vec<u8>]) -> Vec<u8> {
    [&[0xFF, 0xD8][..], &segments.concat(), &[0xFF, 0xDA, 0, 2, 1, 2, 3, 0xFF, 0xD9]].concat()
}

pub(super) fn chunk(kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
    [&(data.len() as u32).to_be_bytes()[..], kind, data, &[0; 4]].concat()
}

pub(super) fn png(chunks: &[Vec<u8>]) -> Vec<u8> {
    [b"\x89PNG\r\n\x1a\n", &chunks.concat()[..]].concat()
}

pub(super) fn webp(chunks: &[(&[u8; 4], Vec<u8>)]) -> Vec<u8> {
    let mut body = b"WEBP".to_vec();
    for (kind, data) in chunks {
        body.extend(*kind);
        body.extend((data.len() as u32).to_le_bytes());
        body.extend(data);
        body.extend(vec![0; data.len() % 2]);
    }
    [&b"RIFF"[..], &(body.len() as u32).to_le_bytes(), &body].concat()
}
