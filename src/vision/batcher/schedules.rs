//! The queue under many thread schedules. No model is run.

use whereabouts_core::DescriptorKind;

use std::sync::atomic::{AtomicUsize, Ordering};

use whereabouts_schedules::{JoinHandle, block_on, check, spawn, yield_now};

use super::tests::queue;
use super::*;

/// Runs in progress, by kind of session.
#[derive(Debug, Default)]
struct Runs {
    latency: AtomicUsize,
    throughput: AtomicUsize,
}

impl Runs {
    /// Answers each request with the width of its picture.
    fn run(&self, kind: SessionKind, batch: Vec<Request>, max_batch: usize) -> Replies {
        let (own, other) = match kind {
            SessionKind::Latency => (&self.latency, &self.throughput),
            SessionKind::Throughput => (&self.throughput, &self.latency),
        };
        own.fetch_add(1, Ordering::SeqCst);
        yield_now();
        assert!((1..=max_batch).contains(&batch.len()));
        assert!(self.latency.load(Ordering::SeqCst) <= 1);
        assert_eq!(other.load(Ordering::SeqCst), 0, "both kinds of session run");
        own.fetch_sub(1, Ordering::SeqCst);
        let answer = |request: Request| {
            (request.reply, Err(InferenceError::Run(request.tensor.width.to_string())))
        };
        batch.into_iter().map(answer).collect()
    }
}

/// A batcher without sessions that has room for `2 * max_batch` pictures.
fn batcher(max_batch: usize) -> Arc<Batcher> {
    Arc::new(Batcher { queue: Arc::new(queue(0, max_batch)), threads: Vec::new() })
}

fn session(batcher: &Arc<Batcher>, runs: &Arc<Runs>, kind: SessionKind) -> JoinHandle<()> {
    let (queue, runs) = (Arc::clone(&batcher.queue), Arc::clone(runs));
    spawn(move || queue.serve(kind, |batch| runs.run(kind, batch, queue.layout.max_batch)))
}

fn submit(batcher: &Batcher, width: usize) -> Result<PendingInference, InferenceError> {
    let waiting = || batcher.queue.lock().waiting.len();
    let tensor = Tensor::grey(width, 1);
    let pending = batcher.submit(tensor, DescriptorKind::GEM.into(), FeatureSet::DescriptorOnly);
    assert!(waiting() <= batcher.queue.layout.capacity());
    pending
}

/// Sends pictures one after another and checks that each gets its own answer.
fn client(batcher: &Arc<Batcher>, widths: [usize; 2]) -> JoinHandle<()> {
    let batcher = Arc::clone(batcher);
    spawn(move || {
        for width in widths {
            match block_on(submit(&batcher, width).unwrap().result()) {
                Err(InferenceError::Run(answer)) => assert_eq!(answer, width.to_string()),
                other => panic!("{other:?}"),
            }
        }
    })
}

fn join_all(threads: impl IntoIterator<Item = JoinHandle<()>>) {
    threads.into_iter().for_each(|thread| thread.join().unwrap());
}

#[test]
fn every_picture_is_answered_while_throughput_sessions_are_added() {
    check(|| {
        let (batcher, runs) = (batcher(1), Arc::new(Runs::default()));
        let latency = session(&batcher, &runs, SessionKind::Latency);
        let clients = [client(&batcher, [1, 2]), client(&batcher, [3, 4])];
        let sessions = [(); 2].map(|()| {
            let session = session(&batcher, &runs, SessionKind::Throughput);
            batcher.queue.add_throughput_session();
            session
        });
        join_all(clients);
        batcher.queue.close();
        join_all(sessions.into_iter().chain([latency]));
    });
}

#[test]
fn a_picture_that_arrives_while_the_first_throughput_session_is_added_does_not_wait_for_the_next() {
    check(|| {
        let (batcher, runs) = (batcher(1), Arc::new(Runs::default()));
        // Earlier pictures overlapped.
        batcher.queue.lock().throughput_mode = true;
        let latency = session(&batcher, &runs, SessionKind::Latency);
        let throughput = session(&batcher, &runs, SessionKind::Throughput);
        let client = client(&batcher, [1, 2]);
        batcher.queue.add_throughput_session();
        join_all([client]);
        batcher.queue.close();
        join_all([latency, throughput]);
    });
}

#[test]
fn pictures_whose_caller_left_block_no_other_picture() {
    check(|| {
        let (batcher, runs) = (batcher(1), Arc::new(Runs::default()));
        let latency = session(&batcher, &runs, SessionKind::Latency);
        let leaving = Arc::clone(&batcher);
        let leaving = spawn(move || (1..4).for_each(|width| drop(submit(&leaving, width))));
        let clients = [client(&batcher, [4, 5]), client(&batcher, [6, 7])];
        join_all(clients.into_iter().chain([leaving]));
        batcher.queue.close();
        join_all([latency]);
    });
}

#[test]
fn closing_the_queue_ends_every_wait() {
    check(|| {
        let (batcher, runs) = (batcher(1), Arc::new(Runs::default()));
        let latency = session(&batcher, &runs, SessionKind::Latency);
        let clients = [1, 2, 3, 4].map(|width| {
            let batcher = Arc::clone(&batcher);
            spawn(move || {
                let result = submit(&batcher, width).map(|pending| block_on(pending.result()));
                assert!(matches!(
                    result,
                    Ok(Err(InferenceError::Run(_) | InferenceError::Stopped))
                        | Err(InferenceError::Stopped)
                ));
            })
        });
        batcher.queue.close();
        join_all(clients.into_iter().chain([latency]));
    });
}
