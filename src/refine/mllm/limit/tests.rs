use super::*;

const SECOND: Duration = Duration::from_secs(1);

fn answer(limit: &mut CallLimit, calls: usize, took: Duration) {
    for _ in 0..calls {
        let call = limit.sent(CallPurpose::Describe);
        limit.answered(call, took, true);
    }
}

#[test]
fn it_starts_below_a_high_bound_and_doubles_until_there() {
    let mut limit = CallLimit::new(1000);
    assert_eq!((limit.get(), CallLimit::new(10).get(), CallLimit::new(0).get()), (START, 10, 1));
    answer(&mut limit, START, SECOND);
    assert_eq!(limit.get(), 2 * START);
    answer(&mut limit, 5000, SECOND);
    assert_eq!(limit.get(), 1000);
}

#[test]
fn it_grows_only_while_it_holds_calls_back() {
    let mut limit = CallLimit::new(1000);
    for _ in 0..1000 {
        let call = limit.sent(CallPurpose::Describe);
        limit.answered(call, SECOND, false);
    }
    assert_eq!(limit.get(), START);
}

#[test]
fn two_refusals_in_a_row_lower_it_to_what_is_borne_and_one_alone_does_not() {
    let mut limit = CallLimit::new(50);
    let call = limit.sent(CallPurpose::Describe);
    limit.turned_away(call, 8);
    assert_eq!(limit.get(), 50);
    limit.turned_away(call, 8);
    // By half at most for what was sent together.
    assert_eq!(limit.get(), 25);
    limit.turned_away(call, 8);
    assert_eq!(limit.get(), 25);
    for left in [12, 8] {
        let call = limit.sent(CallPurpose::Describe);
        limit.turned_away(call, 8);
        assert_eq!(limit.get(), left);
    }
    // It doubles, because it is not known where the server's own limit is, until calls are turned away again.
    answer(&mut limit, 8, SECOND);
    assert_eq!(limit.get(), 16);
    let call = limit.sent(CallPurpose::Describe);
    limit.turned_away(call, 9);
    limit.turned_away(call, 9);
    assert_eq!(limit.get(), 9);
    answer(&mut limit, 5, SECOND);
    assert_eq!(limit.get(), 14);
    // From then on it grows by one a round.
    answer(&mut limit, 10, SECOND);
    assert_eq!(limit.get(), 14);
    answer(&mut limit, 10, SECOND);
    assert_eq!(limit.get(), 15);
}

#[test]
fn refusals_of_what_was_sent_together_are_one_decrease() {
    let mut limit = CallLimit::new(50);
    let calls: Vec<SentCall> = (0..30).map(|_| limit.sent(CallPurpose::Describe)).collect();
    calls.into_iter().for_each(|call| limit.turned_away(call, 50));
    assert_eq!(limit.get(), 45);
}

#[test]
fn several_refusals_among_answers_are_overload_and_rare_ones_are_not() {
    let mut limit = CallLimit::new(50);
    for _ in 0..100 {
        let call = limit.sent(CallPurpose::Describe);
        limit.turned_away(call, 49);
        answer(&mut limit, 20, SECOND);
    }
    assert_eq!(limit.get(), 50);
    for _ in 0..3 {
        let call = limit.sent(CallPurpose::Describe);
        limit.turned_away(call, 49);
        answer(&mut limit, 4, SECOND);
    }
    assert!(limit.get() < 50);
}

#[test]
fn a_halving_is_kept_if_it_made_the_calls_shorter() {
    let mut limit = CallLimit::new(40);
    answer(&mut limit, ROUND, SECOND);
    answer(&mut limit, ROUND, SECOND * 5);
    assert_eq!(limit.get(), 20);
    answer(&mut limit, ROUND, SECOND * 5 / 2);
    assert_eq!(limit.get(), 20);
    answer(&mut limit, ROUND, SECOND * 5 / 2);
    assert_eq!(limit.get(), 10);
    answer(&mut limit, ROUND, SECOND);
    answer(&mut limit, ROUND, SECOND);
    assert!((10..13).contains(&limit.get()), "{limit:?}");
}

#[test]
fn a_halving_is_taken_back_if_the_load_was_not_the_reason() {
    let mut limit = CallLimit::new(40);
    answer(&mut limit, ROUND, SECOND);
    // Longer answers, say.
    answer(&mut limit, ROUND, SECOND * 5);
    assert_eq!(limit.get(), 20);
    answer(&mut limit, 20 * ROUND, SECOND * 5);
    assert_eq!(limit.get(), 40);
}

#[test]
fn one_call_that_hangs_says_nothing_about_the_others() {
    let mut limit = CallLimit::new(40);
    for round in 0..20 {
        answer(&mut limit, ROUND - 1, SECOND);
        let call = limit.sent(CallPurpose::Describe);
        if round % 2 == 0 {
            limit.timed_out(call, 60 * SECOND);
        } else {
            limit.answered(call, 40 * SECOND, true);
        }
    }
    assert_eq!(limit.get(), 40);
}

#[test]
fn calls_that_rank_are_not_compared_with_calls_that_describe() {
    let mut limit = CallLimit::new(40);
    for _ in 0..10 * ROUND {
        answer(&mut limit, 1, SECOND);
        let call = limit.sent(CallPurpose::Rank);
        limit.answered(call, 20 * SECOND, true);
    }
    assert_eq!(limit.get(), 40);
}

#[test]
fn slots_are_a_bound_and_what_a_check_found_is_a_start() {
    let mut limit = CallLimit::new(40);
    limit.start_from(2);
    assert_eq!(limit.get(), 2);
    answer(&mut limit, 2000, SECOND);
    assert_eq!(limit.get(), 40);
    limit.bound_by(4);
    answer(&mut limit, 2000, SECOND);
    assert_eq!(limit.get(), 4);
}
