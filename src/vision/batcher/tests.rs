//! Which session takes which pictures. No model is run.

use super::*;

fn queue(narrow_sessions: usize, max_batch: usize) -> Queue {
    let layout = Layout { threads: 4, sessions: narrow_sessions.max(1), max_batch };
    let state = State { narrow_sessions, ..State::default() };
    Queue { state: state.into(), work: Condvar::new(), room: Condvar::new(), layout }
}

fn submit(queue: &Queue) -> PendingInference {
    let (answer, inferring) = oneshot::channel();
    let mut state = queue.lock();
    state.overlapped |= state.in_progress();
    state.waiting.push_back(Request { tensor: Tensor::grey(1, 1), answer });
    PendingInference(inferring)
}

fn may_take(queue: &Queue) -> (bool, bool) {
    let state = queue.lock();
    (state.may_take(Kind::Wide), state.may_take(Kind::Narrow))
}

/// What a session does, less inference.
fn run(queue: &Queue, kind: Kind) -> (Vec<Request>, Run<'_>) {
    assert!(queue.lock().may_take(kind));
    (queue.take(kind).unwrap(), Run { queue, kind })
}

#[test]
fn a_picture_that_comes_alone_has_all_threads() {
    let queue = queue(2, 1);
    for _ in 0..3 {
        let _inferring = submit(&queue);
        assert_eq!(may_take(&queue), (true, false));
        drop(run(&queue, Kind::Wide));
    }
}

#[test]
fn pictures_that_overlap_are_run_side_by_side_until_none_does() {
    let queue = queue(2, 1);
    let _a = submit(&queue);
    let wide = run(&queue, Kind::Wide);
    let (_b, _c) = (submit(&queue), submit(&queue));
    assert_eq!(may_take(&queue), (false, false));
    drop(wide);
    let (first, second) = (run(&queue, Kind::Narrow), run(&queue, Kind::Narrow));
    drop((first, second));
    let _d = submit(&queue);
    drop(run(&queue, Kind::Narrow));
    let _e = submit(&queue);
    assert_eq!(may_take(&queue), (true, false));
}

#[test]
fn the_wide_session_goes_on_where_there_is_no_other() {
    let queue = queue(0, 8);
    let _a = submit(&queue);
    let wide = run(&queue, Kind::Wide);
    let _more: Vec<_> = (0..9).map(|_| submit(&queue)).collect();
    drop(wide);
    assert_eq!(run(&queue, Kind::Wide).0.len(), 8);
}

#[test]
fn what_waits_is_shared_among_the_narrow_sessions() {
    let queue = queue(2, 8);
    let _inferring: Vec<_> = (0..6).map(|_| submit(&queue)).collect();
    drop(run(&queue, Kind::Wide));
    let _inferring: Vec<_> = (0..6).map(|_| submit(&queue)).collect();
    queue.lock().crowded = true;
    let first = run(&queue, Kind::Narrow);
    assert_eq!((first.0.len(), queue.lock().waiting.len()), (3, 3));
}

#[test]
fn what_nobody_waits_for_any_more_is_not_run() {
    let queue = queue(0, 8);
    let mut inferring: Vec<_> = (0..5).map(|_| submit(&queue)).collect();
    inferring.truncate(2);
    assert_eq!(run(&queue, Kind::Wide).0.len(), 2);
}

#[test]
fn the_room_of_those_who_have_gone_is_given_away() {
    let queue = Arc::new(queue(0, 1));
    let gone: Vec<_> = (0..queue.layout.capacity()).map(|_| submit(&queue)).collect();
    let batcher = Batcher { queue: Arc::clone(&queue), threads: Vec::new() };
    let waits = thread::spawn(move || {
        let inferring = batcher.submit(Tensor::grey(2, 2));
        (batcher, inferring)
    });
    drop(gone);
    let taken = queue.take(Kind::Wide).unwrap();
    assert_eq!((taken.len(), taken[0].tensor.width), (1, 2));
    assert!(waits.join().unwrap().1.is_ok());
}

#[test]
fn who_waits_hears_of_the_end() {
    let queue = Arc::new(queue(0, 1));
    let batcher = Batcher { queue: Arc::clone(&queue), threads: Vec::new() };
    let waits = batcher.submit(Tensor::grey(1, 1)).unwrap();
    drop(batcher);
    assert!(queue.take(Kind::Wide).is_none());
    drop(queue);
    assert!(matches!(waits.wait(), Err(InferenceError::Stopped)));
}
