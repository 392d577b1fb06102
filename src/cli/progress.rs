//! How far a long command has come: a bar on a terminal, a line every few seconds in a pipe.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use parking_lot::Mutex;

pub struct Progress {
    bar: ProgressBar,
    /// What is counted, in the plural.
    what: String,
    on_terminal: bool,
    start: Instant,
    last_line: Mutex<Instant>,
}

impl Progress {
    pub fn new(what: &str, total: usize) -> Self {
        let on_terminal = std::io::stderr().is_terminal();
        let target =
            if on_terminal { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let bar = ProgressBar::with_draw_target(Some(total as u64), target);
        let template = format!("{{bar:40}} {{pos}}/{{len}} {what}, {{per_sec}}, {{eta}} left");
        if let Ok(style) = ProgressStyle::with_template(&template) {
            bar.set_style(style);
        }
        let start = Instant::now();
        Self { bar, what: what.to_owned(), on_terminal, start, last_line: Mutex::new(start) }
    }

    /// One more is done.
    pub fn step(&self) {
        self.bar.inc(1);
        self.line();
    }

    /// So many are done, of so many.
    pub fn at(&self, done: usize, total: usize) {
        self.bar.set_length(total as u64);
        self.bar.set_position(done as u64);
        self.line();
    }

    pub fn say(&self, text: &str) {
        self.bar.suspend(|| eprintln!("{text}"));
    }

    pub fn end(&self) {
        self.bar.finish_and_clear();
    }

    fn line(&self) {
        const PAUSE: Duration = Duration::from_secs(5);
        let mut last_line = self.last_line.lock();
        if !self.on_terminal && last_line.elapsed() >= PAUSE {
            *last_line = Instant::now();
            let (done, total) = (self.bar.position(), self.bar.length().unwrap_or_default());
            let left = self.start.elapsed().as_secs_f64() / done.max(1) as f64
                * total.saturating_sub(done) as f64;
            eprintln!("{done}/{total} {}, about {left:.0} s left", self.what);
        }
    }
}
