//! The gate in front of simulated servers, in simulated time.

use futures_util::future::join_all;
use futures_util::poll;
use parking_lot::Mutex as PlainMutex;

use super::*;

const SECOND: Duration = Duration::from_secs(1);

/// What becomes of a call that a server gets.
enum Fate {
    /// It is answered after that time.
    Answered(Duration),
    /// It is turned away.
    TurnedAway,
}

/// A call as a simulated server sees it.
struct Arrival {
    /// Since the start.
    at: Duration,
    /// Calls in progress, without this one.
    others: usize,
    /// From 1.
    number: usize,
}

/// What a simulated server has seen.
#[derive(Default)]
struct Seen {
    number: usize,
    in_progress: usize,
    turned_away: usize,
    /// When each answered call was answered, and how long it took.
    answered: Vec<(Duration, Duration)>,
}

impl Seen {
    /// The longest call that was answered after that time.
    fn longest_after(&self, after: Duration) -> Duration {
        let late = self.answered.iter().filter(|(at, _)| *at > after);
        late.map(|(_, took)| *took).max().unwrap_or_default()
    }
}

fn place(job: u128) -> CallPlace {
    CallPlace::new(Priority::Normal, Uuid::from_u128(job))
}

/// Makes calls through a gate until all are answered, and returns how long that takes, and what the server has seen.
async fn drive(
    bound: usize,
    calls: usize,
    server: impl Fn(&Arrival) -> Fate,
) -> (Duration, Seen, Arc<CallGate>) {
    let gate = CallGate::new(bound, SECOND / 2);
    let seen = PlainMutex::new(Seen::default());
    let began = Instant::now();
    let call = |job: usize| {
        let (gate, seen, server) = (&gate, &seen, &server);
        async move {
            loop {
                let mut permit = gate.pass(place(job as u128)).await;
                permit.sent(CallPurpose::Describe);
                let arrival = {
                    let mut seen = seen.lock();
                    seen.number += 1;
                    Arrival { at: began.elapsed(), others: seen.in_progress, number: seen.number }
                };
                let fate = server(&arrival);
                seen.lock().in_progress += usize::from(matches!(fate, Fate::Answered(_)));
                // On its way.
                tokio::time::sleep(Duration::from_millis(5)).await;
                match fate {
                    Fate::Answered(took) => {
                        tokio::time::sleep(took).await;
                        permit.answered(took);
                        let mut seen = seen.lock();
                        seen.in_progress -= 1;
                        seen.answered.push((began.elapsed(), took));
                        return;
                    }
                    Fate::TurnedAway => {
                        seen.lock().turned_away += 1;
                        permit.turned_away(None, true);
                        tokio::time::sleep(SECOND / 2).await;
                    }
                }
            }
        }
    };
    join_all((0..calls).map(call)).await;
    let took = began.elapsed();
    (took, seen.into_inner(), gate)
}

fn bears(most: usize, others: usize) -> Fate {
    if others < most { Fate::Answered(SECOND) } else { Fate::TurnedAway }
}

#[tokio::test(start_paused = true)]
async fn a_server_that_bears_everything_is_kept_busy() {
    let (took, seen, _) = drive(100, 2000, |_| Fate::Answered(SECOND)).await;
    assert!(took < 22 * SECOND, "{took:?}");
    assert_eq!(seen.turned_away, 0);
}

#[tokio::test(start_paused = true)]
async fn a_server_that_bears_so_many_at_once_is_kept_busy_and_turns_few_away() {
    for bears_at_once in [1, 8, 40] {
        let calls = 50 * bears_at_once;
        let server = |call: &Arrival| bears(bears_at_once, call.others);
        let (took, seen, gate) = drive(100, calls, server).await;
        let least = SECOND * 50;
        assert!(took < least.mul_f64(1.3), "{bears_at_once}: {took:?}");
        assert!(seen.turned_away < 130 + calls / 5, "{bears_at_once}: {}", seen.turned_away);
        assert!(gate.levels().limit <= bears_at_once + 2, "{:?}", gate.levels());
    }
}

#[tokio::test(start_paused = true)]
async fn a_server_that_is_slow_under_load_gets_no_more_than_it_works_on() {
    // It works on four at a time, and the others wait in its queue.
    let free_at = PlainMutex::new([Duration::ZERO; 4]);
    let server = |call: &Arrival| {
        let mut free_at = free_at.lock();
        let next = free_at.iter_mut().min().unwrap();
        *next = call.at.max(*next) + SECOND;
        Fate::Answered(*next - call.at)
    };
    let (took, seen, gate) = drive(100, 800, server).await;
    assert!(took < (200 * SECOND).mul_f64(1.05), "{took:?}");
    // With a hundred at once, every call would take 25 s.
    let longest = seen.longest_after(100 * SECOND);
    assert!(longest < 9 * SECOND, "{longest:?}");
    assert!(gate.levels().limit < 36, "{:?}", gate.levels());
}

#[tokio::test(start_paused = true)]
async fn a_server_whose_calls_take_longer_for_another_reason_is_kept_busy() {
    let server =
        |call: &Arrival| Fate::Answered(if call.at < 10 * SECOND { SECOND } else { 5 * SECOND });
    let (took, _, _) = drive(50, 50 * 10 + 50 * 20, server).await;
    let least = 10 * SECOND + 20 * 5 * SECOND;
    assert!(took < least.mul_f64(1.15), "{took:?}");
}

#[tokio::test(start_paused = true)]
async fn the_limit_follows_a_server_that_bears_fewer_for_a_while() {
    let server = |call: &Arrival| {
        let at_once = if (20..60).contains(&call.at.as_secs()) { 5 } else { 50 };
        bears(at_once, call.others)
    };
    // 50 a second for 20 s, 5 a second for 40 s, 50 a second again.
    let (took, seen, _) = drive(100, 20 * 50 + 40 * 5 + 40 * 50, server).await;
    assert!(took < 130 * SECOND, "{took:?}");
    assert!(seen.turned_away < 700, "{}", seen.turned_away);
}

#[tokio::test(start_paused = true)]
async fn rare_spurious_refusals_cost_next_to_nothing() {
    let server = |call: &Arrival| match call.number % 97 {
        50 => Fate::TurnedAway,
        _ => Fate::Answered(SECOND),
    };
    let (took, seen, _) = drive(100, 5000, server).await;
    assert!(took < (50 * SECOND).mul_f64(1.1), "{took:?}");
    assert!(seen.turned_away >= 50);
}

#[tokio::test(start_paused = true)]
async fn a_server_that_takes_nothing_for_a_while_is_asked_now_and_then() {
    let server = |call: &Arrival| match (10..40).contains(&call.at.as_secs()) {
        true => Fate::TurnedAway,
        false => Fate::Answered(SECOND),
    };
    let (took, seen, _) = drive(20, 1000, server).await;
    assert!(took < 110 * SECOND, "{took:?}");
    assert!(seen.turned_away < 60, "{}", seen.turned_away);
}

#[tokio::test(start_paused = true)]
async fn refusals_beside_a_call_that_hangs_do_not_lower_the_limit_to_that_call() {
    let gate = CallGate::new(20, SECOND / 2);
    let call = || async {
        let mut permit = gate.pass(place(1)).await;
        permit.sent(CallPurpose::Describe);
        tokio::time::sleep(SECOND).await;
        permit.answered(SECOND);
    };
    join_all((0..20).map(|_| call())).await;
    let mut hangs = gate.pass(place(1)).await;
    assert_eq!(hangs.sent(CallPurpose::Describe), Some(4 * SECOND));
    hangs.is_late();
    for _ in 0..3 {
        let mut permit = gate.pass(place(2)).await;
        permit.sent(CallPurpose::Describe);
        assert!(
            !permit.turned_away(None, true),
            "the call that hangs is none that the server works on"
        );
    }
    let began = Instant::now();
    call().await;
    assert!(began.elapsed() < 4 * SECOND, "{:?}", began.elapsed());
    drop(hangs);
    assert_eq!(gate.levels().sent, 0);
}

#[tokio::test(start_paused = true)]
async fn calls_that_hang_count_against_the_bound_only() {
    let gate = CallGate::new(3, SECOND);
    gate.adjust(|limit| limit.start_from(1));
    let mut hanging = Vec::new();
    for _ in 0..3 {
        let mut permit = gate.pass(place(1)).await;
        permit.sent(CallPurpose::Describe);
        permit.is_late();
        hanging.push(permit);
    }
    let mut next = std::pin::pin!(gate.pass(place(2)));
    assert!(poll!(&mut next).is_pending());
    hanging.pop();
    next.await;
}

#[tokio::test(start_paused = true)]
async fn the_calls_of_the_oldest_job_of_the_highest_priority_go_first() {
    let gate = CallGate::new(1, SECOND);
    let first = gate.pass(place(9)).await;
    let order = PlainMutex::new(Vec::new());
    let high = CallPlace::new(Priority::High, Uuid::from_u128(8));
    let call = |name: &'static str, place: CallPlace| {
        let (gate, order) = (&gate, &order);
        async move {
            let _permit = gate.pass(place).await;
            order.lock().push(name);
        }
    };
    let calls = [
        call("young", place(7)),
        call("old", place(3)),
        call("urgent", high),
        call("old, later", place(3)),
    ];
    let ending = async {
        tokio::time::sleep(SECOND).await;
        drop(first);
    };
    tokio::join!(join_all(calls), ending);
    assert_eq!(*order.lock(), ["urgent", "old", "old, later", "young"]);
}

#[tokio::test(start_paused = true)]
async fn after_a_refusal_of_the_only_call_all_wait_as_long_as_the_server_asks() {
    let gate = CallGate::new(4, SECOND / 2);
    let mut permit = gate.pass(place(1)).await;
    permit.sent(CallPurpose::Describe);
    assert!(!permit.turned_away(Some(7 * SECOND), true));
    let began = Instant::now();
    let _other = gate.pass(place(2)).await;
    assert_eq!(began.elapsed().as_secs(), 7);
}

#[tokio::test(start_paused = true)]
async fn there_is_room_for_a_job_until_half_as_many_calls_wait_as_are_in_progress() {
    let gate = CallGate::new(3, SECOND);
    assert!(gate.has_room());
    let mut wanted = gate.want(10);
    assert!(!gate.has_room());
    let mut room = std::pin::pin!(gate.room());
    assert!(poll!(&mut room).is_pending());
    wanted.truncate(5);
    assert!(poll!(&mut room).is_pending());
    wanted.truncate(4);
    room.await;
    gate.adjust(|limit| limit.start_from(1));
    assert!(!gate.has_room());
    drop(wanted);
    assert!(gate.has_room());
}
