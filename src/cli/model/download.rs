//! Progress of a download: a bar on a terminal, plain lines in a pipe.

use std::io::IsTerminal;

use indicatif::{DecimalBytes, ProgressBar, ProgressStyle};

use whereabouts_models::Progress;

/// Shows one download on standard error.
pub struct DownloadMeter {
    name: String,
    /// `None` unless standard error is a terminal.
    bar: Option<ProgressBar>,
    total: Option<u64>,
    /// The position at which the next line is printed.
    next_line: u64,
}

/// Bytes between two lines if the length is not known; otherwise it is a tenth of the length.
const BYTES_PER_LINE: u64 = 64 << 20;

impl DownloadMeter {
    pub fn new(name: &str) -> Self {
        let bar = std::io::stderr().is_terminal().then(ProgressBar::no_length);
        Self { name: name.to_owned(), bar, total: None, next_line: 0 }
    }

    pub fn show(&mut self, progress: &Progress) {
        match progress {
            Progress::Started { at, total } => self.start(*at, *total),
            Progress::Received(at) => self.advance(*at),
            Progress::Retrying { pause, why } => {
                self.println(&format!("{why}; retrying in {:.1} s", pause.as_secs_f64()));
            }
        }
    }

    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }

    fn start(&mut self, position: u64, total: Option<u64>) {
        self.total = total;
        self.next_line = position + self.bytes_per_line();
        let size = total.map_or("a file of unknown size".into(), |b| DecimalBytes(b).to_string());
        match position {
            0 => self.println(&format!("downloading {size}")),
            _ => self.println(&format!("resuming at {} of {size}", DecimalBytes(position))),
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
            bar.set_position(position);
            bar.reset_eta();
        }
    }

    fn advance(&mut self, position: u64) {
        if let Some(bar) = &self.bar {
            bar.set_position(position);
        } else if position >= self.next_line {
            self.next_line = position + self.bytes_per_line();
            match self.total {
                Some(total) => {
                    self.println(&format!("{} of {}", DecimalBytes(position), DecimalBytes(total)));
                }
                None => self.println(&DecimalBytes(position).to_string()),
            }
        }
    }

    fn bytes_per_line(&self) -> u64 {
        self.total.map_or(BYTES_PER_LINE, |total| (total / 10).max(1))
    }

    fn println(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{}: {text}", self.name)),
            None => eprintln!("{}: {text}", self.name),
        }
    }
}
