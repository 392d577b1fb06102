//! The background thread that brings graphs up to date while searches continue.

use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Weak};
use std::thread;

use rayon::{ThreadPool, ThreadPoolBuilder};

use super::super::StoreError;
use super::live_map::LiveMap;

/// Slots inserted into one map's graph before it is the next map's turn.
const SLOTS_PER_TURN: usize = 64;

/// Builds graphs in the background.
pub(super) struct Indexer {
    threads: Arc<ThreadPool>,
    wake: SyncSender<Weak<LiveMap>>,
}

impl Indexer {
    /// Starts the thread, and a pool of `threads` that share the work on one graph.
    pub fn start(threads: usize) -> Result<Self, StoreError> {
        let failed = |error: &dyn std::error::Error| StoreError::Failed(error.to_string());
        let threads = ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|index| format!("indexer-{index}"))
            .build()
            .map_err(|error| failed(&error))?;
        let threads = Arc::new(threads);
        let (wake, maps) = sync_channel(1024);
        let sharing = Arc::clone(&threads);
        thread::Builder::new()
            .name("indexer".into())
            .spawn(move || run(&maps, &sharing))
            .map_err(|error| failed(&error))?;
        Ok(Self { threads, wake })
    }

    /// Brings the graph of a map up to date and blocks until that is done. The map must not be known to
    /// the background thread yet.
    pub fn finish(&self, map: &LiveMap) {
        while map.index.has_work() {
            step(map, &self.threads);
        }
    }

    /// Asks the background thread to bring the graph of a map up to date.
    pub fn notify(&self, map: &Arc<LiveMap>) {
        if !map.index.has_work() {
            return;
        }
        match self.wake.try_send(Arc::downgrade(map)) {
            // When the queue is full, the map's next change notifies again.
            Ok(()) | Err(TrySendError::Full(_)) => {}
            Err(TrySendError::Disconnected(_)) => tracing::error!("the indexer has stopped"),
        }
    }
}

fn run(wake: &Receiver<Weak<LiveMap>>, threads: &ThreadPool) {
    let mut behind: Vec<Weak<LiveMap>> = Vec::new();
    loop {
        if behind.is_empty() {
            let Ok(map) = wake.recv() else { return };
            behind.push(map);
        }
        for map in wake.try_iter() {
            if !behind.iter().any(|other| other.ptr_eq(&map)) {
                behind.push(map);
            }
        }
        behind.retain(|map| {
            map.upgrade().is_some_and(|map| {
                step(&map, threads);
                map.index.has_work()
            })
        });
    }
}

fn step(map: &LiveMap, threads: &ThreadPool) {
    if let Some(sealed) = map.index.catch_up(map.vectors.as_ref(), SLOTS_PER_TURN, threads) {
        map.store_graph(&sealed);
    }
}
