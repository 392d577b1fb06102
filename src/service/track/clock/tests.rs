use std::time::Duration;

use super::*;

/// The server's time when a test begins.
const NOW: i64 = 1_780_000_000;

/// A robot that sends a frame every `pause` seconds.
struct Robot {
    clock: Clock,
    now: Instant,
    wall: f64,
    pause: f64,
}

impl Robot {
    fn new(pause: f64) -> Self {
        Self { clock: Clock::default(), now: Instant::now(), wall: NOW as f64, pause }
    }

    /// Sends a frame with a time.
    fn frame(&mut self, captured_at: f64) -> (Tick, Option<String>) {
        self.now += Duration::from_secs_f64(self.pause);
        self.wall += self.pause;
        self.clock.read(Some(time(captured_at)), Arrival { at: self.now, clock: time(self.wall) })
    }

    /// Drives for some frames, one a second by the robot's clock, and expects that each second counts.
    fn drives(&mut self, from: f64, frames: usize) -> f64 {
        for number in 0..frames {
            let (tick, _) = self.frame(from + number as f64);
            if number > 0 {
                assert_eq!(tick, next(Elapsed::Seconds(1.0)), "frame {number}");
            }
        }
        from + frames as f64
    }
}

fn time(seconds: f64) -> Timestamp {
    Timestamp::UNIX_EPOCH + SignedDuration::try_from_secs_f64(seconds).unwrap()
}

fn is_next(tick: &Tick) -> bool {
    matches!(tick, Tick::Next { .. })
}

/// Paces at which frames are sent that are a second apart: live, and replayed as fast as possible.
const PACES: [f64; 2] = [1.0, 0.02];

const WRONG: [f64; 4] = [60.0, 3600.0, 86_400.0 * 366.0, -86_400.0 * 366.0 * 30.0];

#[test]
fn a_clock_that_is_wrong_all_the_time_does_no_harm() {
    for pace in PACES {
        for off in WRONG {
            Robot::new(pace).drives(NOW as f64 + off, 50);
        }
    }
}

#[test]
fn a_clock_that_is_ahead_of_the_servers_is_reported_with_what_to_do() {
    for (off, shown) in [(60.0, "1m"), (3600.0, "1h"), (1e8, "27777h")] {
        let (_, warning) = Robot::new(1.0).frame(NOW as f64 + 1.0 + off);
        let warning = warning.unwrap();
        assert!(warning.contains("NTP") && warning.contains(shown), "{warning}");
    }
    for off in [0.0, 3.0, -3600.0] {
        assert_eq!(Robot::new(1.0).frame(NOW as f64 + 1.0 + off).1, None, "{off}");
    }
}

#[test]
fn a_clock_that_was_never_set_is_reported_once() {
    let mut robot = Robot::new(1.0);
    assert!(robot.frame(3.0).1.unwrap().contains("not set"));
    assert_eq!(robot.frame(4.0), (next(Elapsed::Seconds(1.0)), None));
}

#[test]
fn a_clock_that_is_set_while_driving_stops_the_track_for_three_frames_at_most() {
    for pace in PACES {
        for step in WRONG.into_iter().chain([-60.0, -3600.0, -12.0, 1e9 - 7.0]) {
            let mut robot = Robot::new(pace);
            let at = robot.drives(NOW as f64 - 1e7, 30) + step;
            let answers: Vec<_> =
                (0..20).map(|number| robot.frame(at + f64::from(number))).collect();
            let late = answers.iter().filter(|(tick, _)| !is_next(tick)).count();
            assert!(late <= 2, "{step} at {pace}: {late}");
            assert!(answers[3..].iter().all(|(tick, _)| is_next(tick)), "{step} at {pace}");
            let told = answers.iter().filter(|(_, warning)| warning.is_some()).count();
            assert!(told >= 1, "{step} at {pace}");
            assert_eq!(answers[19].0, next(Elapsed::Seconds(1.0)));
        }
    }
}

#[test]
fn one_frame_with_a_wrong_time_stops_nothing() {
    for pace in PACES {
        for off in [60.0, 3600.0, 1e8] {
            let mut robot = Robot::new(pace);
            let at = robot.drives(NOW as f64 - 1e9, 10);
            let (wrong, warning) = robot.frame(at + off);
            assert!(matches!(wrong, Tick::Next { or_else: Some(_), .. }), "{wrong:?}");
            assert!(warning.is_some());
            let (right, _) = robot.frame(at + 1.0);
            assert_eq!(right, reset(Elapsed::Seconds(1.0)), "{off} at {pace}");
            robot.drives(at + 2.0, 10);
        }
    }
}

#[test]
fn a_clock_that_is_put_right_is_believed_at_once() {
    let mut robot = Robot::new(1.0);
    robot.drives(NOW as f64 + 3600.0, 10);
    let (tick, warning) = robot.frame(robot.wall + 1.0);
    assert!(matches!(tick, Tick::Next { is_reset: true, .. }), "{tick:?}");
    assert!(warning.unwrap().contains("set back"));
}

#[test]
fn a_recording_that_starts_again_goes_on_after_three_frames() {
    let mut robot = Robot::new(0.02);
    let start = NOW as f64 - 1e6;
    robot.drives(start, 100);
    let ticks: Vec<_> = (0..10).map(|number| robot.frame(start + f64::from(number)).0).collect();
    assert_eq!(ticks.iter().filter(|tick| !is_next(tick)).count(), 2);
}

#[test]
fn frames_out_of_order_are_late_and_do_not_move_the_clock() {
    let mut robot = Robot::new(1.0);
    let at = robot.drives(NOW as f64, 20);
    for late in [at - 5.0, at - 5.0, at - 7.0, at - 3.0] {
        assert_eq!(robot.frame(late).0, Tick::Late(time(late)));
    }
    assert!(matches!(robot.frame(at).0, Tick::Next { is_reset: false, .. }));
}

#[test]
fn frames_that_were_stored_while_the_network_was_away_are_late() {
    let mut robot = Robot::new(1.0);
    let at = robot.drives(NOW as f64, 20);
    robot.pause = 60.0;
    robot.frame(at + 59.0);
    robot.pause = 0.05;
    for number in 0..50 {
        let stored = at + f64::from(number);
        assert_eq!(robot.frame(stored).0, Tick::Late(time(stored)));
    }
    robot.pause = 1.0;
    assert!(matches!(robot.frame(at + 62.0).0, Tick::Next { is_reset: false, .. }));
}

#[test]
fn a_pause_is_a_pause() {
    let mut robot = Robot::new(1.0);
    let at = robot.drives(NOW as f64, 20);
    robot.pause = 3600.0;
    assert_eq!(robot.frame(at + 3599.0), (next(Elapsed::Seconds(3600.0)), None));
}

#[test]
fn a_clock_in_another_unit_is_not_used_and_reported() {
    for unit in [1e3, 1e6] {
        let mut robot = Robot::new(0.5);
        let answers: Vec<_> =
            (0..20).map(|number| robot.frame(1e5 + unit * 0.5 * f64::from(number))).collect();
        let (tick, warning) = &answers[19];
        assert_eq!(*tick, next(Elapsed::Intervals(1.0)), "{unit}");
        assert!(warning.as_ref().is_some_and(|text| text.contains("seconds")), "{warning:?}");
    }
}

#[test]
fn a_clock_that_has_stopped_is_not_used_and_reported() {
    let mut robot = Robot::new(0.5);
    let answers: Vec<_> = (0..60).map(|_| robot.frame(NOW as f64)).collect();
    let (tick, warning) = &answers[59];
    assert_eq!(*tick, next(Elapsed::Intervals(1.0)));
    assert!(warning.as_ref().is_some_and(|text| text.contains("leave captured_at out")));
    // A clock with a resolution of seconds, at thirty frames a second, is fine.
    let mut robot = Robot::new(1.0 / 30.0);
    for number in 0..200 {
        let (_, warning) = robot.frame(NOW as f64 + f64::from(number / 30));
        assert_eq!(warning, None, "{number}");
    }
}
