//! The database written anew: its files do not shrink by themselves when records go.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use super::super::StoreError;
use super::schema;
use super::trees::{Trees, failed};
use super::{check_folder, lock};

/// Records copied between two flushes.
const BATCH: usize = 4096;
const CACHE_BYTES: u64 = 64 << 20;

/// Bytes of the database before and after.
#[derive(Debug, Clone, Copy, serde::Serialize)]
pub struct Compacted {
    /// Before.
    pub bytes_before: u64,
    /// After.
    pub bytes_after: u64,
}

/// Writes the database of a folder anew, beside the old one, and puts it in its place. No server may use
/// the folder meanwhile; there must be room for both.
pub fn compact(dir: &Path) -> Result<Compacted, StoreError> {
    check_folder(dir)?;
    let _lock = lock(dir)?;
    schema::bring_up_to_date(dir)?;
    settle(dir)?;
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
    settle(dir)?;
    let bytes_after = Trees::open(&db, CACHE_BYTES)?.bytes()?;
    Ok(Compacted { bytes_before, bytes_after })
}

/// Ends a compaction that broke off: with the new database if it was in its place, else with the old.
pub(super) fn settle(dir: &Path) -> Result<(), StoreError> {
    let [db, fresh, old] = paths(dir);
    if old.is_dir() && !db.is_dir() {
        fs::rename(&old, &db).map_err(|error| cannot("restore", &db, &error))?;
    }
    for rest in [fresh, old] {
        if rest.is_dir() {
            fs::remove_dir_all(&rest).map_err(|error| cannot("remove", &rest, &error))?;
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
            let what = format!("tree {number} has {records} records, its copy {}", copy.len());
            return Err(StoreError::Failed(what));
        }
    }
    to.flush()
}

fn paths(dir: &Path) -> [PathBuf; 3] {
    ["db", "db.compact", "db.before-compact"].map(|name| dir.join(name))
}

fn cannot(what: &str, path: &Path, error: &std::io::Error) -> StoreError {
    StoreError::Failed(format!("cannot {what} {}: {error}", path.display()))
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
    fn what_was_removed_gives_its_room_back_and_the_rest_stays() {
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
    fn a_compaction_that_broke_off_leaves_one_whole_database() {
        let dir = tempfile::tempdir().unwrap();
        drop(fill(dir.path(), 3));
        let [db, fresh, old] = paths(dir.path());
        fs::create_dir(&fresh).unwrap();
        fs::rename(&db, &old).unwrap();
        settle(dir.path()).unwrap();
        assert_eq!(Trees::open(&db, 1 << 20).unwrap().frames.len(), 3);
        assert!(!fresh.exists() && !old.exists());
    }
}
