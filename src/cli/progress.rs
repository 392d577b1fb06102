//! Progress of a long command: a bar on a terminal, a line every few seconds in a pipe.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use parking_lot::Mutex;

/// Shows on standard error how many items are done.
pub struct ProgressMeter {
    bar: ProgressBar,
    /// What is counted, in the plural.
    unit: String,
    on_terminal: bool,
    start: Instant,
    last_line: Mutex<Instant>,
}

impl ProgressMeter {
    pub fn new(unit: &str, total: usize) -> Self {
        let on_terminal = std::io::stderr().is_terminal();
        let target =
            if on_terminal { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let bar = ProgressBar::with_draw_target(Some(total as u64), target);
        let template = format!("{{bar:40}} {{pos}}/{{len}} {unit}, {{per_sec}}, {{eta}} left");
        if let Ok(style) = ProgressStyle::with_template(&template) {
            bar.set_style(style);
        }
        let start = Instant::now();
        Self { bar, unit: unit.to_owned(), on_terminal, start, last_line: Mutex::new(start) }
    }

    /// Counts one more item.
    pub fn step(&self) {
        self.bar.inc(1);
        self.print_line_if_due();
    }

    /// Sets both counts.
    pub fn set(&self, done: usize, total: usize) {
        self.bar.set_length(total as u64);
        self.bar.set_position(done as u64);
        self.print_line_if_due();
    }

    /// Prints a line without tearing the bar.
    pub fn println(&self, text: &str) {
        self.bar.suspend(|| eprintln!("{text}"));
    }

    /// Removes the bar.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }

    fn print_line_if_due(&self) {
        const INTERVAL: Duration = Duration::from_secs(5);
        let mut last_line = self.last_line.lock();
        if !self.on_terminal && last_line.elapsed() >= INTERVAL {
            *last_line = Instant::now();
            let (done, total) = (self.bar.position(), self.bar.length().unwrap_or_default());
            let remaining = self.start.elapsed().as_secs_f64() / done.max(1) as f64
                * total.saturating_sub(done) as f64;
            eprintln!("{done}/{total} {}, about {remaining:.0} s left", self.unit);
        }
    }
}
