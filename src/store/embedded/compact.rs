//! Compaction: sled's files do not shrink when records are deleted, so the records are copied to a new
//! database.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use super::super::StoreError;
use super::schema;
use super::trees::{Trees, failed};
use super::{check_folder, lock};

/// Records copied between two flushes.
const BATCH: usize = 4096;
const CACHE_BYTES: u64 = 64 << 20;

/// The size of the database before and after a compaction.
#[derive(Debug, Clone, Copy, serde::Serialize)]
pub struct Compacted {
    /// Bytes before.
    pub bytes_before: u64,
    /// Bytes after.
    pub bytes_after: u64,
}

/// Copies the records of a data folder to a new database and replaces the old one with it. No server may
/// use the folder meanwhile, and the disk must have room for both databases.
pub fn compact(dir: &Path) -> Result<Compacted, StoreError> {
    check_folder(dir)?;
    let _lock = lock(dir)?;
    schema::bring_up_to_date(dir)?;
    finish_interrupted(dir)?;
    let [db, fresh, old] = paths(dir);
    let bytes_before = {
        let (from, to) = (Trees::open(&db, CACHE_BYTES)?, Trees::open(&fresh, CACHE_BYTES)?);
        copy(&from, &to)?;
        from.bytes()?
    };
    let moved = fs::rename(&db, &old)
        .and_then(|()| fs::rename(&fresh, &db))
        .and_then(|()| File::open(dir)?.sync_all());
    moved.map_err(|error| cannot("replace", &db, &error))?;
    finish_interrupted(dir)?;
    let bytes_after = Trees::open(&db, CACHE_BYTES)?.bytes()?;
    Ok(Compacted { bytes_before, bytes_after })
}

/// Finishes an interrupted compaction: keeps the new database if it was already in place, otherwise the
/// old one.
pub(super) fn finish_interrupted(dir: &Path) -> Result<(), StoreError> {
    let [db, fresh, old] = paths(dir);
    if old.is_dir() && !db.is_dir() {
        fs::rename(&old, &db).map_err(|error| cannot("restore", &db, &error))?;
    }
    for leftover in [fresh, old] {
        if leftover.is_dir() {
            fs::remove_dir_all(&leftover).map_err(|error| cannot("remove", &leftover, &error))?;
        }
    }
    Ok(())
}

fn copy(from: &Trees, to: &Trees) -> Result<(), StoreError> {
    for (number, tree) in from.all()?.into_iter().enumerate() {
        let copy = to.tree(&tree.name())?;
        let mut records = 0;
        for entry in tree.iter() {
            let (key, value) = entry.map_err(failed)?;
            copy.insert(key, value).map_err(failed)?;
            records += 1;
            if records % BATCH == 0 {
                to.flush()?;
            }
        }
        if copy.len() != records {
            let copied = copy.len();
            return Err(StoreError::Failed(format!(
                "tree {number} has {records} records, but its copy has {copied}"
            )));
        }
    }
    to.flush()
}

fn paths(dir: &Path) -> [PathBuf; 3] {
    ["db", "db.compact", "db.before-compact"].map(|name| dir.join(name))
}

fn cannot(action: &str, path: &Path, error: &std::io::Error) -> StoreError {
    StoreError::Failed(format!("cannot {action} {}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::super::trees::put;
    use super::*;

    fn fill(dir: &Path, records: u32) -> Trees {
        let trees = Trees::open(&dir.join("db"), 1 << 20).unwrap();
        for number in 0..records {
            put(&trees.frames, &number.to_be_bytes(), &"x".repeat(2000)).unwrap();
        }
        trees.flush().unwrap();
        trees
    }

    #[test]
    fn compaction_frees_the_space_of_deleted_records_and_keeps_the_others() {
        let dir = tempfile::tempdir().unwrap();
        let trees = fill(dir.path(), 5000);
        for number in 10..5000_u32 {
            trees.frames.remove(number.to_be_bytes()).unwrap();
        }
        trees.set_commit_number(7).unwrap();
        trees.flush().unwrap();
        drop(trees);
        let compacted = compact(dir.path()).unwrap();
        assert!(compacted.bytes_after * 4 < compacted.bytes_before, "{compacted:?}");
        let trees = Trees::open(&dir.path().join("db"), 1 << 20).unwrap();
        assert_eq!((trees.frames.len(), trees.commit_number().unwrap()), (10, 7));
        assert!(!dir.path().join("db.before-compact").exists());
    }

    #[test]
    fn an_interrupted_compaction_leaves_one_complete_database() {
        let dir = tempfile::tempdir().unwrap();
        drop(fill(dir.path(), 3));
        let [db, fresh, old] = paths(dir.path());
        fs::create_dir(&fresh).unwrap();
        fs::rename(&db, &old).unwrap();
        finish_interrupted(dir.path()).unwrap();
        assert_eq!(Trees::open(&db, 1 << 20).unwrap().frames.len(), 3);
        assert!(!fresh.exists() && !old.exists());
    }
}
