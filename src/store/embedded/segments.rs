//! Descriptors on disk: append-only segments of fixed-size rows, read through memory maps.
//!
//! ```text
//! header, 64 bytes   "WHEREVEC", version, dim, rows of a segment, CRC-32 of these, zeros
//! row                CRC-32, zero, slot (64 bits), dim × f32
//! ```
//!
//! All numbers are little-endian. The CRC-32 of a row covers its slot and its numbers, so that it
//! detects rows that were never written, are torn, or belong to another slot. A header says nothing
//! that the map's record does not, so a damaged one is written again.

use std::fs::{self, File};
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use memmap2::Mmap;
use parking_lot::RwLock;

use super::super::StoreError;
use whereabouts_core::Descriptor;
use whereabouts_index::Vectors;

const MAGIC: &[u8; 8] = b"WHEREVEC";
const VERSION: u32 = 1;
const HEADER_BYTES: usize = 64;
const ROW_HEADER_BYTES: usize = 16;
/// Rows of a segment. The file is sparse, so unused rows take no space.
const ROWS: usize = 8192;

#[cfg(target_endian = "big")]
compile_error!("segments are mapped as they are on disk, which is little-endian");

/// The segments of one map.
pub(super) struct VectorFiles {
    dir: PathBuf,
    dim: usize,
    segments: RwLock<Vec<Arc<Segment>>>,
}

struct Segment {
    file: File,
    map: Mmap,
    dirty: AtomicBool,
}

impl VectorFiles {
    /// Opens the segments in `dir`, which is created if it does not exist.
    pub fn open(dir: PathBuf, dim: usize) -> Result<Self, StoreError> {
        let files = Self { dir, dim, segments: RwLock::default() };
        fs::create_dir_all(&files.dir).map_err(|error| files.failed("create", &error))?;
        while files.path(files.count()).is_file() {
            files.grow()?;
        }
        Ok(files)
    }

    /// Writes a descriptor; it is durable after the next [`Self::sync`].
    pub fn write(&self, slot: usize, vector: &[f32]) -> Result<(), StoreError> {
        if vector.len() != self.dim {
            return Err(StoreError::Conflict(format!(
                "a descriptor of {} numbers does not fit a map of {}",
                vector.len(),
                self.dim
            )));
        }
        while self.count() <= slot / ROWS {
            self.grow()?;
        }
        let slot_bytes = (slot as u64).to_le_bytes();
        let mut row = Vec::with_capacity(self.stride());
        row.extend(checksum(&slot_bytes, bytemuck::cast_slice(vector)).to_le_bytes());
        row.extend([0; 4]);
        row.extend(slot_bytes);
        row.extend_from_slice(bytemuck::cast_slice(vector));
        let Some(segment) = self.segment(slot / ROWS) else {
            return Err(StoreError::Failed("a fresh segment is missing".into()));
        };
        segment
            .file
            .write_all_at(&row, self.offset(slot) as u64)
            .map_err(|error| self.failed("write to", &error))?;
        segment.dirty.store(true, Ordering::Release);
        Ok(())
    }

    /// Makes all descriptors written so far durable.
    pub fn sync(&self) -> Result<(), StoreError> {
        let segments = self.segments.read().clone();
        for segment in segments {
            if segment.dirty.swap(false, Ordering::AcqRel) {
                segment.file.sync_data().map_err(|error| self.failed("sync", &error))?;
            }
        }
        Ok(())
    }

    /// Whether the row of `slot` holds a descriptor with a valid checksum.
    pub fn is_intact(&self, slot: usize) -> bool {
        self.segment(slot / ROWS).is_some_and(|segment| {
            let (header, vector) = self.row(&segment, slot);
            header[8..] == (slot as u64).to_le_bytes()
                && header[..4] == checksum(&header[8..], vector).to_le_bytes()
        })
    }

    /// Returns the descriptor of `slot`; `None` if the row is empty or damaged.
    pub fn read(&self, slot: usize) -> Option<Descriptor> {
        if !self.is_intact(slot) {
            return None;
        }
        let segment = self.segment(slot / ROWS)?;
        let numbers: &[f32] = bytemuck::cast_slice(self.row(&segment, slot).1);
        Descriptor::stored(numbers.to_vec()).ok()
    }

    fn grow(&self) -> Result<(), StoreError> {
        let path = self.path(self.count());
        let segment = self.open_segment(&path).map_err(|error| {
            StoreError::Failed(format!("cannot open the segment {}: {error}", path.display()))
        })?;
        self.segments.write().push(Arc::new(segment));
        Ok(())
    }

    fn open_segment(&self, path: &std::path::Path) -> io::Result<Segment> {
        let file =
            File::options().create(true).truncate(false).read(true).write(true).open(path)?;
        let length = (HEADER_BYTES + ROWS * self.stride()) as u64;
        let header = self.header();
        if file.metadata()?.len() < HEADER_BYTES as u64 {
            file.set_len(length)?;
            file.write_all_at(&header, 0)?;
            file.sync_all()?;
            File::open(&self.dir)?.sync_all()?;
        }
        let mut found = [0; HEADER_BYTES];
        file.read_exact_at(&mut found, 0)?;
        if found != header {
            if is_header(&found) {
                return Err(io::Error::other(
                    "its header is of another version or dimension; start the version that wrote it, \
                     or restore a backup into a new folder",
                ));
            }
            tracing::warn!(
                file = %path.display(),
                "the header of a segment is damaged; it is written again, and each row is checked"
            );
            file.write_all_at(&header, 0)?;
            file.sync_data()?;
        }
        // The missing end of a truncated segment reads as zeros, which fail the checksum.
        if file.metadata()?.len() < length {
            file.set_len(length)?;
        }
        #[expect(unsafe_code, reason = "memory-mapping is unsafe by signature")]
        // SAFETY: the data folder is locked, so no other process changes the file; this process never
        // truncates it, and writes a row before any reader knows its slot.
        let map = unsafe { Mmap::map(&file)? };
        Ok(Segment { file, map, dirty: AtomicBool::new(false) })
    }

    fn header(&self) -> [u8; HEADER_BYTES] {
        let mut header = [0; HEADER_BYTES];
        header[..8].copy_from_slice(MAGIC);
        header[8..12].copy_from_slice(&VERSION.to_le_bytes());
        header[12..16].copy_from_slice(&(self.dim as u32).to_le_bytes());
        header[16..20].copy_from_slice(&(ROWS as u32).to_le_bytes());
        let crc = crc32fast::hash(&header[..20]);
        header[20..24].copy_from_slice(&crc.to_le_bytes());
        header
    }

    fn row<'a>(&self, segment: &'a Segment, slot: usize) -> (&'a [u8], &'a [u8]) {
        let start = self.offset(slot);
        segment.map[start..start + self.stride()].split_at(ROW_HEADER_BYTES)
    }

    fn offset(&self, slot: usize) -> usize {
        HEADER_BYTES + (slot % ROWS) * self.stride()
    }

    /// Returns the size of a number of rows, in bytes.
    pub fn bytes_of(&self, rows: usize) -> u64 {
        (rows * self.stride()) as u64
    }

    fn stride(&self) -> usize {
        ROW_HEADER_BYTES + self.dim * size_of::<f32>()
    }

    fn count(&self) -> usize {
        self.segments.read().len()
    }

    fn segment(&self, index: usize) -> Option<Arc<Segment>> {
        self.segments.read().get(index).cloned()
    }

    fn path(&self, index: usize) -> PathBuf {
        self.dir.join(format!("{index:06}.seg"))
    }

    fn failed(&self, action: &str, error: &io::Error) -> StoreError {
        StoreError::Failed(format!("cannot {action} {}: {error}", self.dir.display()))
    }
}

impl Vectors for VectorFiles {
    fn dim(&self) -> usize {
        self.dim
    }

    fn scan(&self, slots: Range<usize>, visit: &mut dyn FnMut(usize, &[f32])) {
        let mut slot = slots.start;
        while slot < slots.end {
            let Some(segment) = self.segment(slot / ROWS) else { return };
            let end = slots.end.min((slot / ROWS + 1) * ROWS);
            for slot in slot..end {
                visit(slot, bytemuck::cast_slice(self.row(&segment, slot).1));
            }
            slot = end;
        }
    }
}

/// Whether this is an undamaged header, of whatever version.
fn is_header(bytes: &[u8; HEADER_BYTES]) -> bool {
    bytes.starts_with(MAGIC) && bytes[20..24] == crc32fast::hash(&bytes[..20]).to_le_bytes()
}

fn checksum(slot: &[u8], vector: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(slot);
    hasher.update(vector);
    hasher.finalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(files: &VectorFiles, slots: Range<usize>) -> Vec<(usize, Vec<f32>)> {
        let mut rows = Vec::new();
        files.scan(slots, &mut |slot, vector| rows.push((slot, vector.to_vec())));
        rows
    }

    #[test]
    fn descriptors_in_several_segments_survive_reopening() {
        let dir = tempfile::tempdir().unwrap();
        let slots = [0, 1, ROWS - 1, ROWS, 2 * ROWS + 5];
        let files = VectorFiles::open(dir.path().join("m"), 3).unwrap();
        for slot in slots {
            files.write(slot, &[slot as f32, 1.0, -1.0]).unwrap();
        }
        files.sync().unwrap();
        drop(files);
        let files = VectorFiles::open(dir.path().join("m"), 3).unwrap();
        for slot in slots {
            assert!(files.is_intact(slot));
            assert_eq!(rows(&files, slot..slot + 1), [(slot, vec![slot as f32, 1.0, -1.0])]);
        }
        assert!(!files.is_intact(2), "a row that was never written");
        assert!(!files.is_intact(9 * ROWS), "a segment that was never created");
    }

    #[test]
    fn a_damaged_row_is_detected() {
        let dir = tempfile::tempdir().unwrap();
        let files = VectorFiles::open(dir.path().join("m"), 4).unwrap();
        files.write(0, &[1.0; 4]).unwrap();
        files.write(1, &[2.0; 4]).unwrap();
        let file = File::options().write(true).open(files.path(0)).unwrap();
        file.write_all_at(&[7], (files.offset(0) + ROW_HEADER_BYTES + 2) as u64).unwrap();
        assert!(!files.is_intact(0));
        assert!(files.is_intact(1));
    }

    #[test]
    fn a_segment_of_another_dimension_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        VectorFiles::open(dir.path().join("m"), 4).unwrap().write(0, &[1.0; 4]).unwrap();
        let error = VectorFiles::open(dir.path().join("m"), 5).map(drop).unwrap_err();
        assert!(error.to_string().contains("header"), "{error}");
    }

    #[test]
    fn a_damaged_header_is_written_again_and_loses_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let files = VectorFiles::open(dir.path().join("m"), 4).unwrap();
        files.write(0, &[1.0; 4]).unwrap();
        let path = files.path(0);
        drop(files);
        for (at, bytes) in
            [(0, vec![0; HEADER_BYTES]), (3, vec![b'x']), (12, vec![5]), (22, vec![9])]
        {
            File::options().write(true).open(&path).unwrap().write_all_at(&bytes, at).unwrap();
            let files = VectorFiles::open(dir.path().join("m"), 4).unwrap();
            assert!(files.is_intact(0), "{} bytes at {at}", bytes.len());
            assert_eq!(fs::read(&path).unwrap()[..HEADER_BYTES], files.header());
        }
    }

    #[test]
    fn a_truncated_segment_loses_only_the_missing_rows() {
        let dir = tempfile::tempdir().unwrap();
        let files = VectorFiles::open(dir.path().join("m"), 4).unwrap();
        for slot in 0..3 {
            files.write(slot, &[1.0; 4]).unwrap();
        }
        let (path, length) = (files.path(0), files.offset(2) as u64);
        drop(files);
        File::options().write(true).open(path).unwrap().set_len(length).unwrap();
        let files = VectorFiles::open(dir.path().join("m"), 4).unwrap();
        assert_eq!([0, 1, 2].map(|slot| files.is_intact(slot)), [true, true, false]);
    }
}
