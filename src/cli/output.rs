//! Printing, in place of the standard macros of the same names, which panic where nobody reads any more
//! (`whereabouts jobs | head`) and where the disk of a redirection is full.

use std::fmt::Arguments;
use std::io::{ErrorKind, Write};

/// The exit code where standard output cannot be written.
const CANNOT_WRITE: i32 = 1;

/// Writes to standard output, and a line break if `line` says so. Ends the process if that is impossible: quietly where
/// the reader has left, as it has what it wanted, and with a message otherwise.
pub(crate) fn write(text: Arguments<'_>, line: bool) {
    let mut out = std::io::stdout().lock();
    let end = if line { "\n" } else { "" };
    match out.write_fmt(format_args!("{text}{end}")).and_then(|()| out.flush()) {
        Ok(()) => {}
        Err(error) if error.kind() == ErrorKind::BrokenPipe => std::process::exit(0),
        Err(error) => {
            complain(format_args!("whereabouts: standard output cannot be written: {error}"));
            std::process::exit(CANNOT_WRITE);
        }
    }
}

/// Writes a line to standard error. There is no place to report that it cannot be written.
pub(crate) fn complain(text: Arguments<'_>) {
    let _ = writeln!(std::io::stderr().lock(), "{text}");
}

macro_rules! println {
    () => { $crate::output::write(format_args!(""), true) };
    ($($text:tt)*) => { $crate::output::write(format_args!($($text)*), true) };
}

macro_rules! print {
    ($($text:tt)*) => { $crate::output::write(format_args!($($text)*), false) };
}

macro_rules! eprintln {
    ($($text:tt)*) => { $crate::output::complain(format_args!($($text)*)) };
}
