//! How far a command has come: a bar on a terminal, a line every few seconds in a pipe.

use std::cell::Cell;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// Shows on the standard error how many images are done.
pub struct Progress {
    bar: ProgressBar,
    on_terminal: bool,
    last_line: Cell<Instant>,
}

impl Progress {
    pub fn new(total: usize) -> Self {
        let on_terminal = std::io::stderr().is_terminal();
        let target =
            if on_terminal { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let bar = ProgressBar::with_draw_target(Some(total as u64), target);
        if let Ok(style) =
            ProgressStyle::with_template("{bar:40} {pos}/{len} images, {per_sec}, {eta} left")
        {
            bar.set_style(style);
        }
        Self { bar, on_terminal, last_line: Cell::new(Instant::now()) }
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
        if !self.on_terminal && self.last_line.get().elapsed() >= PAUSE {
            self.last_line.set(Instant::now());
            eprintln!("{}/{} images", self.bar.position(), self.bar.length().unwrap_or_default());
        }
    }
}
