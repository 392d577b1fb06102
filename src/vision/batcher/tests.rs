//! Which session takes which pictures. No model is run.

use whereabouts_core::DescriptorKind;

use super::*;

fn kinds() -> Arc<Kinds> {
    let text = include_str!("../../../deploy/models/xfeat.toml");
    let manifest = crate::Manifest::parse(text, std::path::Path::new("xfeat.toml")).unwrap();
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../deploy/models");
    Arc::new(Kinds::load(&manifest, std::path::Path::new(folder)).unwrap())
}

pub(super) fn queue(throughput_sessions: usize, max_batch: usize) -> Queue {
    let layout = Layout { threads: 4, sessions: throughput_sessions.max(1), max_batch };
    let state = State { throughput_sessions, ..State::default() };
    Queue {
        state: state.into(),
        work_available: Condvar::new(),
        room_available: Condvar::new(),
        layout,
        kinds: kinds(),
    }
}

fn submit(queue: &Queue) -> PendingInference {
    let (reply, result) = oneshot::channel();
    let mut state = queue.lock();
    let (spec, features) = (DescriptorKind::GEM.into(), FeatureSet::DescriptorOnly);
    state.push(Request { tensor: Tensor::grey(1, 1), spec, features, reply });
    PendingInference(result)
}

fn may_take(queue: &Queue) -> (bool, bool) {
    let state = queue.lock();
    (state.may_take(SessionKind::Latency), state.may_take(SessionKind::Throughput))
}

/// What a session thread does, without inference.
fn run(queue: &Queue, kind: SessionKind) -> (Vec<Request>, Running<'_>) {
    assert!(queue.lock().may_take(kind));
    (queue.take(kind).unwrap(), Running { queue, kind })
}

#[test]
fn a_picture_that_arrives_alone_gets_the_latency_session() {
    let queue = queue(2, 1);
    for _ in 0..3 {
        let _pending = submit(&queue);
        assert_eq!(may_take(&queue), (true, false));
        drop(run(&queue, SessionKind::Latency));
    }
}

#[test]
fn overlapping_pictures_use_throughput_sessions_until_the_queue_is_idle() {
    let queue = queue(2, 1);
    let _a = submit(&queue);
    let latency = run(&queue, SessionKind::Latency);
    let (_b, _c) = (submit(&queue), submit(&queue));
    assert_eq!(may_take(&queue), (false, false));
    drop(latency);
    let (first, second) =
        (run(&queue, SessionKind::Throughput), run(&queue, SessionKind::Throughput));
    drop((first, second));
    let _d = submit(&queue);
    drop(run(&queue, SessionKind::Throughput));
    let _e = submit(&queue);
    assert_eq!(may_take(&queue), (true, false));
}

#[test]
fn the_latency_session_serves_alone_without_throughput_sessions() {
    let queue = queue(0, 8);
    let _a = submit(&queue);
    let latency = run(&queue, SessionKind::Latency);
    let _more: Vec<_> = (0..9).map(|_| submit(&queue)).collect();
    drop(latency);
    assert_eq!(run(&queue, SessionKind::Latency).0.len(), 8);
}

#[test]
fn throughput_sessions_share_the_queue_evenly() {
    let queue = queue(2, 8);
    let _pending: Vec<_> = (0..6).map(|_| submit(&queue)).collect();
    drop(run(&queue, SessionKind::Latency));
    let _pending: Vec<_> = (0..6).map(|_| submit(&queue)).collect();
    queue.lock().throughput_mode = true;
    let first = run(&queue, SessionKind::Throughput);
    assert_eq!((first.0.len(), queue.lock().waiting.len()), (3, 3));
}

#[test]
fn abandoned_pictures_are_not_run() {
    let queue = queue(0, 8);
    let mut pending: Vec<_> = (0..5).map(|_| submit(&queue)).collect();
    pending.truncate(2);
    assert_eq!(run(&queue, SessionKind::Latency).0.len(), 2);
}

#[test]
fn abandoned_pictures_make_room_in_the_queue() {
    let queue = Arc::new(queue(0, 1));
    let abandoned: Vec<_> = (0..queue.layout.capacity()).map(|_| submit(&queue)).collect();
    let batcher = Batcher { queue: Arc::clone(&queue), threads: Vec::new() };
    let waiting = thread::spawn(move || {
        let pending = batcher.submit(
            Tensor::grey(2, 2),
            DescriptorKind::GEM.into(),
            FeatureSet::DescriptorOnly,
        );
        (batcher, pending)
    });
    drop(abandoned);
    let batch = queue.take(SessionKind::Latency).unwrap();
    assert_eq!((batch.len(), batch[0].tensor.width), (1, 2));
    assert!(waiting.join().unwrap().1.is_ok());
}

#[test]
fn waiting_callers_fail_when_a_session_panics() {
    let queue = Arc::new(queue(0, 1));
    let pending = [submit(&queue), submit(&queue)];
    let serving = Arc::clone(&queue);
    let session =
        thread::spawn(move || serving.serve(SessionKind::Latency, |_| panic!("on purpose")));
    for pending in pending {
        assert!(matches!(pending.wait(), Err(InferenceError::Stopped)));
    }
    assert!(session.join().is_err() && queue.take(SessionKind::Latency).is_none());
}

#[test]
fn waiting_callers_fail_when_the_batcher_is_dropped() {
    let queue = Arc::new(queue(0, 1));
    let batcher = Batcher { queue: Arc::clone(&queue), threads: Vec::new() };
    let waiting = batcher
        .submit(Tensor::grey(1, 1), DescriptorKind::GEM.into(), FeatureSet::DescriptorOnly)
        .unwrap();
    drop(batcher);
    assert!(queue.take(SessionKind::Latency).is_none());
    drop(queue);
    assert!(matches!(waiting.wait(), Err(InferenceError::Stopped)));
}
