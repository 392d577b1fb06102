//! Walks the directories of a TIFF structure, as far as they can be followed.

use super::container::is_tiff;

/// Most directories of one structure that are looked at.
const MAX_DIRECTORIES: usize = 16;

const GPS_DIRECTORY: u16 = 0x8825;
const EXIF_DIRECTORY: u16 = 0x8769;
const SUB_DIRECTORIES: u16 = 0x014A;
const XMP_PACKET: u16 = 0x02BC;

/// What the directories of a structure say about a position.
#[derive(Debug, Default)]
pub(super) struct Contents<'a> {
    /// The fields of each GPS directory.
    pub gps: Vec<Vec<Field<'a>>>,
    /// XMP packets, which TIFF pictures have in a field.
    pub xmp: Vec<&'a [u8]>,
}

/// A TIFF structure (TIFF 6.0), the form of EXIF data.
pub(super) struct Tiff<'a> {
    bytes: &'a [u8],
    order: ByteOrder,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum ByteOrder {
    Little,
    Big,
}

impl ByteOrder {
    fn u16(self, bytes: [u8; 2]) -> u16 {
        match self {
            Self::Little => u16::from_le_bytes(bytes),
            Self::Big => u16::from_be_bytes(bytes),
        }
    }

    fn u32(self, bytes: [u8; 4]) -> u32 {
        match self {
            Self::Little => u32::from_le_bytes(bytes),
            Self::Big => u32::from_be_bytes(bytes),
        }
    }

    fn f64(self, bytes: [u8; 8]) -> f64 {
        match self {
            Self::Little => f64::from_le_bytes(bytes),
            Self::Big => f64::from_be_bytes(bytes),
        }
    }
}

/// A field of a directory.
#[derive(Debug, Clone)]
pub(super) struct Field<'a> {
    pub tag: u16,
    kind: u16,
    data: &'a [u8],
    order: ByteOrder,
}

/// One number of a field.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Number {
    /// A finite number.
    Value(f64),
    /// The fraction 0/0, which says that the value is unknown or unused.
    Unknown,
    /// A fraction with the denominator 0, NaN, or infinity.
    Invalid,
}

impl Number {
    pub(super) fn of(value: f64) -> Self {
        if value.is_finite() { Self::Value(value) } else { Self::Invalid }
    }

    pub(super) fn fraction(numerator: f64, denominator: f64) -> Self {
        match (numerator == 0.0, denominator == 0.0) {
            (true, true) => Self::Unknown,
            (false, true) => Self::Invalid,
            _ => Self::of(numerator / denominator),
        }
    }
}

impl<'a> Tiff<'a> {
    /// Recognises a TIFF structure by its first bytes.
    pub(super) fn parse(bytes: &'a [u8]) -> Option<Self> {
        let order = if bytes.starts_with(b"MM") { ByteOrder::Big } else { ByteOrder::Little };
        is_tiff(bytes).then_some(Self { bytes, order })
    }

    /// Walks the directories.
    pub(super) fn contents(&self) -> Contents<'a> {
        let mut found = Contents::default();
        let Some(first) = self.u32(4) else { return found };
        let (mut queue, mut seen) = (vec![first], Vec::new());
        while let Some(offset) = queue.pop() {
            if seen.contains(&offset) || seen.len() >= MAX_DIRECTORIES {
                continue;
            }
            seen.push(offset);
            // Absent in the files of some writers, and wrong in those of others.
            let after =
                offset as usize + 2 + 12 * usize::from(self.u16(offset as usize).unwrap_or(0));
            queue.extend(self.u32(after).filter(|&next| next != 0));
            for field in self.fields(offset) {
                match field.tag {
                    GPS_DIRECTORY => {
                        found.gps.extend(field.offset().map(|gps| self.fields(gps)));
                    }
                    XMP_PACKET => found.xmp.push(field.data),
                    EXIF_DIRECTORY | SUB_DIRECTORIES => queue.extend(field.offset()),
                    _ => {}
                }
            }
        }
        found
    }

    /// Returns the fields of a directory that lie within the structure.
    fn fields(&self, directory: u32) -> Vec<Field<'a>> {
        let start = directory as usize;
        let count = usize::from(self.u16(start).unwrap_or(0));
        (0..count).map_while(|index| self.entry(start + 2 + 12 * index)).flatten().collect()
    }

    /// Reads an entry: `None` outside the structure, `Some(None)` if its value is.
    fn entry(&self, at: usize) -> Option<Option<Field<'a>>> {
        let entry = self.bytes.get(at..at.checked_add(12)?)?;
        let (tag, kind) = (self.u16(at)?, self.u16(at + 2)?);
        let count = self.u32(at + 4)? as usize;
        let Some(size) = size_of(kind).and_then(|size| size.checked_mul(count)) else {
            return Some(None);
        };
        let data = match size {
            0..=4 => &entry[8..8 + size],
            _ => {
                let offset = self.u32(at + 8)? as usize;
                let Some(data) =
                    offset.checked_add(size).and_then(|end| self.bytes.get(offset..end))
                else {
                    return Some(None);
                };
                data
            }
        };
        Some(Some(Field { tag, kind, data, order: self.order }))
    }

    fn u16(&self, at: usize) -> Option<u16> {
        let bytes = self.bytes.get(at..)?.first_chunk::<2>()?;
        Some(self.order.u16(*bytes))
    }

    fn u32(&self, at: usize) -> Option<u32> {
        let bytes = self.bytes.get(at..)?.first_chunk::<4>()?;
        Some(self.order.u32(*bytes))
    }
}

const BYTE: u16 = 1;
const ASCII: u16 = 2;
const SHORT: u16 = 3;
const LONG: u16 = 4;
const RATIONAL: u16 = 5;
const SBYTE: u16 = 6;
const UNDEFINED: u16 = 7;
const SSHORT: u16 = 8;
const SLONG: u16 = 9;
const SRATIONAL: u16 = 10;
const FLOAT: u16 = 11;
const DOUBLE: u16 = 12;
const IFD: u16 = 13;

/// Size of one value of a type, in bytes.
fn size_of(kind: u16) -> Option<usize> {
    match kind {
        BYTE | ASCII | SBYTE | UNDEFINED => Some(1),
        SHORT | SSHORT => Some(2),
        LONG | SLONG | FLOAT | IFD => Some(4),
        RATIONAL | SRATIONAL | DOUBLE => Some(8),
        _ => None,
    }
}

impl<'a> Field<'a> {
    /// A field of the same meaning that was found as text elsewhere.
    pub(super) fn of_text(tag: u16, text: &'a str) -> Self {
        Self { tag, kind: ASCII, data: text.as_bytes(), order: ByteOrder::Little }
    }

    /// The offset of a directory.
    fn offset(&self) -> Option<u32> {
        match self.kind {
            SHORT => self.data.first_chunk().map(|bytes| u32::from(self.order.u16(*bytes))),
            _ => self.data.first_chunk().map(|bytes| self.order.u32(*bytes)),
        }
    }

    /// The text, if the field holds any: up to the first NUL, without spaces around it.
    pub(super) fn text(&self) -> Option<String> {
        if !matches!(self.kind, ASCII | BYTE | UNDEFINED) {
            return None;
        }
        let bytes = self.data.iter().copied().skip_while(|&byte| byte == 0);
        let text: Vec<u8> = bytes.take_while(|&byte| byte != 0).collect();
        let is_text = !text.is_empty() && text.iter().all(|byte| (b' '..=b'~').contains(byte));
        is_text.then(|| String::from_utf8_lossy(&text).trim().to_owned())
    }

    /// Whether the field has the type of text.
    pub(super) fn is_text(&self) -> bool {
        matches!(self.kind, ASCII | UNDEFINED)
    }

    /// The numbers; empty if the field holds text.
    pub(super) fn numbers(&self) -> Vec<Number> {
        let Some(size) = size_of(self.kind) else { return Vec::new() };
        self.data.chunks_exact(size).filter_map(|chunk| self.number(chunk)).collect()
    }

    fn number(&self, bytes: &[u8]) -> Option<Number> {
        let order = self.order;
        let u16 = || bytes.first_chunk().map(|bytes| order.u16(*bytes));
        let u32_at = |at: usize| bytes.get(at..)?.first_chunk().map(|bytes| order.u32(*bytes));
        Some(match self.kind {
            BYTE => Number::of(f64::from(*bytes.first()?)),
            SBYTE => Number::of(f64::from(bytes.first()?.cast_signed())),
            SHORT => Number::of(f64::from(u16()?)),
            SSHORT => Number::of(f64::from(u16()?.cast_signed())),
            LONG => Number::of(f64::from(u32_at(0)?)),
            SLONG => Number::of(f64::from(u32_at(0)?.cast_signed())),
            RATIONAL => Number::fraction(f64::from(u32_at(0)?), f64::from(u32_at(4)?)),
            SRATIONAL => Number::fraction(
                f64::from(u32_at(0)?.cast_signed()),
                f64::from(u32_at(4)?.cast_signed()),
            ),
            FLOAT => Number::of(f64::from(f32::from_bits(u32_at(0)?))),
            DOUBLE => Number::of(order.f64(*bytes.first_chunk()?)),
            _ => return None,
        })
    }
}
