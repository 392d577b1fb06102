//! The version of a data folder, and the migrations that bring an older folder up to date.
//!
//! The version is in a separate file, `DATA/version`, because it must be known before the database is
//! opened: opening it writes to it, and a later version may keep its records elsewhere. A folder that
//! has a database but no such file has version 1.
//!
//! | version | changes |
//! |---|---|
//! | 1 | |
//! | 2 | queue keys begin with the job's priority; ended jobs are listed by end time |
//! | 3 | what searches need of an image is also listed by slot |

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use uuid::Uuid;
use walkdir::WalkDir;

use super::super::StoreError;
use super::super::changes::ended_at;
use super::blobs::replace_durably;
use super::trees::{Lease, Trees, decode, ended_key, failed, put, queue_key};
use crate::JobRecord;

const FILE: &str = "version";

/// The migrations in order, the first from version 1 to version 2.
const MIGRATIONS: &[Migration] = &[
    Migration { changes: &["db"], apply: add_priorities_and_end_times },
    Migration { changes: &["db"], apply: list_images_by_slot },
];

/// Size of sled's page cache during a migration, in bytes.
const CACHE_BYTES: u64 = 64 << 20;

/// A migration from one version to the next.
struct Migration {
    /// The subfolders that it changes, which are copied first.
    changes: &'static [&'static str],
    /// Applies the migration. It runs again if it was interrupted, on whatever it left.
    apply: fn(&Path) -> Result<(), StoreError>,
}

/// The version that this program reads and writes.
pub(super) fn newest() -> u32 {
    MIGRATIONS.len() as u32 + 1
}

/// Brings the data folder to this program's version, or refuses it. Call it while holding the lock.
pub(super) fn bring_up_to_date(dir: &Path) -> Result<(), StoreError> {
    migrate(dir, MIGRATIONS)
}

/// Returns the version of the data folder; `None` if the folder is empty.
pub(super) fn version_of(dir: &Path) -> Result<Option<u32>, StoreError> {
    let path = dir.join(FILE);
    match fs::read_to_string(&path) {
        Ok(text) => match text.trim().parse() {
            Ok(version) if version > 0 => Ok(Some(version)),
            _ => Err(StoreError::Damaged(format!(
                "{} does not contain a version; restore the data folder from a copy, or create a new \
                 one and `whereabouts restore` a backup",
                path.display()
            ))),
        },
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            Ok(dir.join("db").is_dir().then_some(1))
        }
        Err(error) => Err(cannot("read", &path, &error)),
    }
}

/// Returns where the migration to `version` stores its copy of the folder as it was before.
pub(super) fn copy_before(dir: &Path, version: u32) -> PathBuf {
    dir.join(format!("before-version-{version}"))
}

/// Explains why a folder of a later version is refused, and what to do.
pub(super) fn too_new(dir: &Path, version: u32, newest: u32) -> String {
    format!(
        "the data folder {} is of version {version}, but this program supports versions up to {newest}: \
         a later release of whereabouts has used the folder. Run that release, or use its `whereabouts \
         backup` and restore the backup into a new folder with this one",
        dir.display()
    )
}

fn migrate(dir: &Path, migrations: &[Migration]) -> Result<(), StoreError> {
    let newest = migrations.len() as u32 + 1;
    let Some(mut version) = version_of(dir)? else { return write_version(dir, newest) };
    if version > newest {
        return Err(StoreError::Conflict(too_new(dir, version, newest)));
    }
    for migration in &migrations[version as usize - 1..] {
        let copy = copy_before(dir, version + 1);
        tracing::info!(
            folder = %dir.display(), from = version, to = version + 1, copy = %copy.display(),
            "the data folder is brought to a newer version"
        );
        copy_first(dir, migration.changes, &copy)?;
        (migration.apply)(dir)?;
        version += 1;
        write_version(dir, version)?;
        tracing::info!(
            copy = %copy.display(),
            "done; the copy may be deleted once the server is known to work"
        );
    }
    if !dir.join(FILE).is_file() {
        write_version(dir, version)?;
    }
    Ok(())
}

fn write_version(dir: &Path, version: u32) -> Result<(), StoreError> {
    let path = dir.join(FILE);
    replace_durably(&path, &path.with_extension("tmp"), format!("{version}\n").as_bytes())
        .and_then(|()| File::open(dir)?.sync_all())
        .map_err(|error| cannot("write", &path, &error))
}

/// Copies what a migration changes. An existing copy is from an interrupted run, before it changed
/// anything, and is kept.
fn copy_first(dir: &Path, changes: &[&str], copy: &Path) -> Result<(), StoreError> {
    if copy.is_dir() {
        return Ok(());
    }
    let incomplete = copy.with_extension("tmp");
    let copied = || -> io::Result<()> {
        if incomplete.exists() {
            fs::remove_dir_all(&incomplete)?;
        }
        fs::create_dir_all(&incomplete)?;
        for change in changes {
            copy_folder(&dir.join(change), &incomplete.join(change))?;
        }
        fs::rename(&incomplete, copy)?;
        File::open(dir)?.sync_all()
    };
    copied().map_err(|error| {
        StoreError::Failed(format!(
            "the data folder cannot be migrated to a newer version, because its records cannot be \
             copied to {} first: {error}; free some space and start again, nothing was changed",
            copy.display()
        ))
    })
}

fn copy_folder(from: &Path, to: &Path) -> io::Result<()> {
    for entry in WalkDir::new(from) {
        let entry = entry?;
        let target = to.join(entry.path().strip_prefix(from).map_err(io::Error::other)?);
        if entry.file_type().is_dir() {
            fs::create_dir_all(&target)?;
        } else {
            fs::copy(entry.path(), &target)?;
            File::open(&target)?.sync_all()?;
        }
    }
    Ok(())
}

fn cannot(action: &str, path: &Path, error: &io::Error) -> StoreError {
    StoreError::Failed(format!("cannot {action} {}: {error}", path.display()))
}

/// The migration to version 2.
fn add_priorities_and_end_times(dir: &Path) -> Result<(), StoreError> {
    let trees = Trees::open(&dir.join("db"), CACHE_BYTES)?;
    for entry in trees.jobs.iter() {
        let (key, value) = entry.map_err(failed)?;
        let record: JobRecord = decode(&value)?;
        if record.job.state.is_final() {
            let key = ended_key(ended_at(&record.job), record.job.id);
            trees.ended.insert(key, &[]).map_err(failed)?;
        } else if trees.queue.contains_key(&key).map_err(failed)? {
            put(&trees.queue, &queue_key(&record.job), &Lease::None)?;
        }
    }
    for key in trees.queue.iter().keys() {
        let key = key.map_err(failed)?;
        if Uuid::from_slice(&key).is_ok() {
            trees.queue.remove(&key).map_err(failed)?;
        }
    }
    trees.flush()
}

/// The migration to version 3.
fn list_images_by_slot(dir: &Path) -> Result<(), StoreError> {
    let trees = Trees::open(&dir.join("db"), CACHE_BYTES)?;
    for map in trees.maps()? {
        for stored in trees.images_of(map.uid) {
            trees.put_entry(map.uid, &stored?)?;
        }
    }
    trees.flush()
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::super::images::{Entry, StoredImage};
    use super::super::test_records;
    use super::*;
    use crate::Query;
    use whereabouts_core::{
        Digest, GeographicPose, Image, Job, JobState, MediaType, Pose, RefinerKind,
    };

    fn first(dir: &Path) -> Result<(), StoreError> {
        fs::write(dir.join("db/records"), "two").map_err(|error| cannot("write", dir, &error))
    }

    fn second(dir: &Path) -> Result<(), StoreError> {
        let records = fs::read_to_string(dir.join("db/records")).unwrap();
        match dir.join("db/stop").exists() {
            true => Err(StoreError::Failed("pulled the plug".into())),
            false => fs::write(dir.join("db/records"), records + ", three")
                .map_err(|error| cannot("write", dir, &error)),
        }
    }

    const TWO: &[Migration] = &[
        Migration { changes: &["db"], apply: first },
        Migration { changes: &["db"], apply: second },
    ];

    fn folder() -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir(dir.path().join("db")).unwrap();
        fs::write(dir.path().join("db/records"), "one").unwrap();
        dir
    }

    fn read(dir: &Path, file: &str) -> String {
        fs::read_to_string(dir.join(file)).unwrap()
    }

    #[test]
    fn an_older_folder_is_copied_before_each_migration() {
        let dir = folder();
        migrate(dir.path(), TWO).unwrap();
        assert_eq!(read(dir.path(), "db/records"), "two, three");
        assert_eq!(read(dir.path(), "before-version-2/db/records"), "one");
        assert_eq!(read(dir.path(), "before-version-3/db/records"), "two");
        assert_eq!(read(dir.path(), FILE), "3\n");
        migrate(dir.path(), TWO).unwrap();
        assert_eq!(read(dir.path(), "db/records"), "two, three");
    }

    #[test]
    fn an_interrupted_migration_runs_again_and_keeps_its_copy() {
        let dir = folder();
        fs::write(dir.path().join("db/stop"), "").unwrap();
        assert!(migrate(dir.path(), TWO).is_err());
        assert_eq!(version_of(dir.path()).unwrap(), Some(2));
        // Simulates a partly applied migration.
        fs::write(dir.path().join("db/records"), "half").unwrap();
        fs::remove_file(dir.path().join("db/stop")).unwrap();
        migrate(dir.path(), TWO).unwrap();
        assert_eq!(read(dir.path(), "before-version-3/db/records"), "two");
        assert_eq!(read(dir.path(), "db/records"), "half, three");
    }

    #[test]
    fn a_newer_folder_is_refused_and_not_changed() {
        let dir = folder();
        fs::write(dir.path().join(FILE), "4\n").unwrap();
        let error = migrate(dir.path(), TWO).unwrap_err().to_string();
        assert!(error.contains("version 4") && error.contains("up to 3"), "{error}");
        assert_eq!(read(dir.path(), "db/records"), "one");
        fs::write(dir.path().join(FILE), "many").unwrap();
        assert!(matches!(migrate(dir.path(), TWO), Err(StoreError::Damaged(_))));
    }

    #[test]
    fn a_new_folder_has_the_newest_version() {
        let dir = tempfile::tempdir().unwrap();
        migrate(dir.path(), TWO).unwrap();
        assert_eq!(version_of(dir.path()).unwrap(), Some(3));
        assert!(!copy_before(dir.path(), 2).exists());
    }

    #[test]
    fn a_job_queued_under_version_1_keeps_its_place_in_the_queue() {
        let dir = tempfile::tempdir().unwrap();
        let record = |state| {
            let now = Timestamp::now();
            let id = Uuid::now_v7();
            let query = Query {
                id,
                digest: Digest::of(b"frame"),
                media_type: MediaType::Jpeg,
                created_at: now,
                descriptor: None,
                uninformative: None,
            };
            let job = Job::queued("m".parse().unwrap(), id, RefinerKind::Local, now);
            let job = Job { state, finished_at: state.is_final().then_some(now), ..job };
            let (map_uid, candidates) = (Uuid::nil(), vec![]);
            JobRecord { job, map_uid, revision: 0, query, candidates, claims: 0, traceparent: None }
        };
        let (unfinished, ended) = (record(JobState::Running), record(JobState::Failed));
        let trees = Trees::open(&dir.path().join("db"), 1 << 20).unwrap();
        for record in [&unfinished, &ended] {
            put(&trees.jobs, record.job.id.as_bytes(), record).unwrap();
        }
        put(&trees.queue, unfinished.job.id.as_bytes(), &Some(Timestamp::now())).unwrap();
        trees.flush().unwrap();
        drop(trees);
        bring_up_to_date(dir.path()).unwrap();
        let trees = Trees::open(&dir.path().join("db"), 1 << 20).unwrap();
        let keys = |tree: &sled::Tree| -> Vec<Vec<u8>> {
            tree.iter().keys().map(|key| key.unwrap().to_vec()).collect()
        };
        assert_eq!(keys(&trees.queue), [queue_key(&unfinished.job)]);
        let at = ended.job.finished_at.unwrap();
        assert_eq!(keys(&trees.ended), [ended_key(at, ended.job.id)]);
        assert!(copy_before(dir.path(), 2).join("db").is_dir());
    }

    #[test]
    fn images_of_an_older_folder_are_listed_by_slot() {
        let dir = tempfile::tempdir().unwrap();
        let map = test_records::map();
        let image = |id: &str, pose| Image { pose, ..test_records::image(id, id.as_bytes()) };
        let pose = GeographicPose { lat: 1.0, lon: 2.0, alt: None, heading: Some(90.0) };
        let images = [image("a", Some(Pose::Geographic(pose))), image("b", None)];
        let trees = Trees::open(&dir.path().join("db"), CACHE_BYTES).unwrap();
        put(&trees.maps, b"m", &map).unwrap();
        let stored =
            |slot: usize| StoredImage { image: images[slot].clone(), slot, recording: None };
        for slot in 0..2 {
            trees.insert_image(map.uid, &stored(slot)).unwrap();
            // Version 2 did not list it.
            trees.forget_slot(map.uid, slot).unwrap();
        }
        trees.flush().unwrap();
        drop(trees);
        fs::write(dir.path().join(FILE), "2\n").unwrap();
        bring_up_to_date(dir.path()).unwrap();
        let trees = Trees::open(&dir.path().join("db"), CACHE_BYTES).unwrap();
        let listed = trees.entries_in(map.uid, 0..2).collect::<Result<Vec<_>, _>>().unwrap();
        assert_eq!(listed, [0, 1].map(|slot| (slot, Entry::from(&stored(slot)))));
    }
}
