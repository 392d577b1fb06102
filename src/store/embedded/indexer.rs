//! The thread that brings graphs up to date behind the backs of searches.

use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Weak};
use std::thread;

use rayon::{ThreadPool, ThreadPoolBuilder};

use super::super::StoreError;
use super::live_map::LiveMap;

/// Slots put into a graph before the next map has its turn.
const TURN: usize = 64;

/// Builds graphs in the background.
pub(super) struct Indexer {
    threads: Arc<ThreadPool>,
    wake: SyncSender<Weak<LiveMap>>,
}

impl Indexer {
    /// `threads` share the work on one graph.
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

    /// Brings a map up to date that nobody else has got hold of yet. Blocks.
    pub fn finish(&self, map: &LiveMap) {
        while map.index.has_work() {
            step(map, &self.threads);
        }
    }

    /// Asks for a map to be brought up to date.
    pub fn look_at(&self, map: &Arc<LiveMap>) {
        if !map.index.has_work() {
            return;
        }
        match self.wake.try_send(Arc::downgrade(map)) {
            // So many notices wait that this map's next image will bring another.
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
            if !behind.iter().any(|known| known.ptr_eq(&map)) {
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
    if let Some(sealed) = map.index.catch_up(map.vectors.as_ref(), TURN, threads) {
        map.keep(&sealed);
    }
}
