//! How a download goes on: a bar on a terminal, plain lines elsewhere.

use std::io::IsTerminal;

use indicatif::{DecimalBytes, ProgressBar, ProgressStyle};

use whereabouts_models::Progress;

/// Shows one download on the standard error.
pub struct Screen {
    name: String,
    /// Only on a terminal.
    bar: Option<ProgressBar>,
    total: Option<u64>,
    /// The position from which on the next line is due.
    next_line: u64,
}

/// A line for each tenth, or for so many bytes where the length is not known.
const BYTES_A_LINE: u64 = 64 << 20;

impl Screen {
    pub fn new(name: &str) -> Self {
        let bar = std::io::stderr().is_terminal().then(ProgressBar::no_length);
        Self { name: name.to_owned(), bar, total: None, next_line: 0 }
    }

    pub fn show(&mut self, progress: &Progress) {
        match progress {
            Progress::Started { at, total } => self.start(*at, *total),
            Progress::Received(at) => self.advance(*at),
            Progress::Retrying { pause, why } => {
                self.say(&format!("{why}; trying again in {:.1} s", pause.as_secs_f64()));
            }
        }
    }

    pub fn end(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }

    fn start(&mut self, at: u64, total: Option<u64>) {
        self.total = total;
        self.next_line = at + self.bytes_a_line();
        let whole =
            total.map_or("a file of unknown length".into(), |b| DecimalBytes(b).to_string());
        match at {
            0 => self.say(&format!("downloading {whole}")),
            _ => self.say(&format!("continuing at {} of {whole}", DecimalBytes(at))),
        }
        if let Some(bar) = &self.bar {
            if let Some(total) = total {
                bar.set_length(total);
            }
            let template = "{wide_bar} {decimal_bytes}/{decimal_total_bytes}  \
                            {decimal_bytes_per_sec}, {eta} left";
            if let Ok(style) = ProgressStyle::with_template(template) {
                bar.set_style(style);
            }
            bar.set_position(at);
            bar.reset_eta();
        }
    }

    fn advance(&mut self, at: u64) {
        if let Some(bar) = &self.bar {
            bar.set_position(at);
        } else if at >= self.next_line {
            self.next_line = at + self.bytes_a_line();
            match self.total {
                Some(total) => {
                    self.say(&format!("{} of {}", DecimalBytes(at), DecimalBytes(total)))
                }
                None => self.say(&DecimalBytes(at).to_string()),
            }
        }
    }

    fn bytes_a_line(&self) -> u64 {
        self.total.map_or(BYTES_A_LINE, |total| (total / 10).max(1))
    }

    fn say(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{}: {text}", self.name)),
            None => eprintln!("{}: {text}", self.name),
        }
    }
}
