//! Reads tables as people have them: separated by commas, semicolons, tabs or bars; with a byte order mark, in
//! UTF-8 or UTF-16; with comments; with any of several names for a column.

use std::path::Path;

use anyhow::{Context, bail};

/// Largest table in bytes: more than a hundred rows for each of a million images.
const MAX_BYTES: u64 = 512 << 20;

const SEPARATORS: [u8; 4] = [b',', b';', b'\t', b'|'];

/// A table with a header.
#[derive(Debug)]
pub(super) struct Table {
    /// Names of the columns as they are in the file.
    pub header: Vec<String>,
    /// The rows that are neither empty nor comments.
    pub rows: Vec<TableRow>,
}

/// A row of a table, with as many cells as the header.
#[derive(Debug)]
pub(super) struct TableRow {
    /// Its line in the file, from 1.
    pub line: u64,
    pub cells: Vec<String>,
}

impl Table {
    /// Reads a table. The header is the first line that is neither empty nor a comment, or the comment before it
    /// if only that has a column that `is_key` knows by its name as [`plain`] returns it.
    ///
    /// # Errors
    /// The file cannot be read, is not text, has no header, or a row has more cells than the header.
    pub(super) fn read(file: &Path, is_key: impl Fn(&str) -> bool) -> anyhow::Result<Self> {
        let name = file.display();
        let metadata = file.metadata().with_context(|| format!("cannot read {name}"))?;
        if !metadata.is_file() {
            bail!("{name} is not a file; name a table");
        }
        if metadata.len() > MAX_BYTES {
            bail!("{name} has more than {MAX_BYTES} bytes; split it, and the folder with it");
        }
        let bytes = std::fs::read(file).with_context(|| format!("cannot read {name}"))?;
        let mut text = decoded(&bytes).with_context(|| name.to_string())?;
        if !text.contains('\n') {
            // The line ends of old spreadsheets, at which the CSV reader would not end a comment.
            text = text.replace('\r', "\n");
        }
        let head = Head::find(&text, is_key).with_context(|| {
            format!("{name} has no row of column names; begin it with one, such as file,lat,lon")
        })?;
        let mut reader = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .has_headers(false)
            .flexible(true)
            .comment(Some(b'#'))
            .delimiter(head.separator)
            .from_reader(head.rest.as_bytes());
        let mut rows = Vec::new();
        let (mut at, mut line) = (0, head.lines + 1);
        for record in reader.records() {
            let record = record.with_context(|| name.to_string())?;
            // The position is before the empty lines and comments that were skipped.
            let before = record.position().map_or(0, csv::Position::byte) as usize;
            let start = start_of_row(head.rest, before);
            line += lines_in(&head.rest[at..start]);
            at = start;
            let mut cells: Vec<String> = record.iter().map(str::to_owned).collect();
            if cells.iter().all(String::is_empty) {
                continue;
            }
            let extra = cells.iter().skip(head.columns.len()).any(|cell| !cell.is_empty());
            if extra {
                bail!(
                    "{name} line {line} has {} cells, and the header has {}; if the numbers have decimal commas, \
                     quote them or separate the columns with semicolons or tabs",
                    cells.len(),
                    head.columns.len()
                );
            }
            cells.resize(head.columns.len(), String::new());
            rows.push(TableRow { line, cells });
        }
        Ok(Self { header: head.columns, rows })
    }
}

/// The beginning of a table.
struct Head<'a> {
    columns: Vec<String>,
    separator: u8,
    /// Number of lines before `rest`.
    lines: u64,
    rest: &'a str,
}

impl<'a> Head<'a> {
    fn find(text: &'a str, is_key: impl Fn(&str) -> bool) -> Option<Self> {
        let (mut rest, mut lines) = (text, 0);
        let mut comment: Option<&str> = None;
        let mut declared = None;
        loop {
            let (line, after) = first_line(rest);
            if rest.is_empty() {
                return None;
            }
            let content = line.trim_matches([' ', '\t', '\u{a0}']);
            if let Some(text) = content.strip_prefix('#') {
                comment = Some(text);
            } else if let Some(separator) = content.strip_prefix("sep=") {
                // Written by spreadsheets.
                declared = separator.bytes().next();
            } else if !content.is_empty() {
                let (separator, columns) = split(line, declared, &is_key);
                let has_key = |columns: &[String]| columns.iter().any(|name| is_key(&plain(name)));
                let of_comment = comment.map(|text| split(text, declared, &is_key));
                return Some(match of_comment {
                    Some((separator, columns)) if has_key(&columns) => {
                        Self { columns, separator, lines, rest }
                    }
                    _ => Self { columns, separator, lines: lines + 1, rest: after },
                });
            }
            (rest, lines) = (after, lines + 1);
        }
    }
}

/// Splits a header with the separator that yields most columns with a known key, then most columns.
fn split(line: &str, declared: Option<u8>, is_key: impl Fn(&str) -> bool) -> (u8, Vec<String>) {
    let columns = |separator: u8| {
        let mut reader = csv::ReaderBuilder::new()
            .has_headers(false)
            .trim(csv::Trim::All)
            .delimiter(separator)
            .from_reader(line.as_bytes());
        let record = reader.records().next().and_then(Result::ok).unwrap_or_default();
        record.iter().map(str::to_owned).collect::<Vec<String>>()
    };
    let candidates = declared.map_or_else(|| SEPARATORS.to_vec(), |separator| vec![separator]);
    let best = candidates.into_iter().map(|separator| (separator, columns(separator)));
    // The last of equals would win; the comma shall.
    let best = best.rev().max_by_key(|(_, columns)| {
        (columns.iter().any(|name| is_key(&plain(name))), columns.len())
    });
    best.unwrap_or((b',', vec![line.to_owned()]))
}

fn first_line(text: &str) -> (&str, &str) {
    match text.find(['\n', '\r']) {
        Some(end) => {
            let length = if text[end..].starts_with("\r\n") { 2 } else { 1 };
            (&text[..end], &text[end + length..])
        }
        None => (text, ""),
    }
}

/// Skips the empty lines and comments at a position.
fn start_of_row(text: &str, mut at: usize) -> usize {
    while let Some(rest) = text.get(at..).filter(|rest| !rest.is_empty()) {
        let (line, after) = first_line(rest);
        if !(line.is_empty() || line.starts_with('#')) {
            break;
        }
        at = text.len() - after.len();
    }
    at.min(text.len())
}

/// Counts the line ends in a text.
fn lines_in(text: &str) -> u64 {
    let is_end = |(index, byte): &(usize, u8)| match byte {
        b'\n' => true,
        b'\r' => text.as_bytes().get(index + 1) != Some(&b'\n'),
        _ => false,
    };
    text.bytes().enumerate().filter(is_end).count() as u64
}

/// The name of a column without case, spaces, punctuation and units.
pub(super) fn plain(name: &str) -> String {
    let end = name.find(['(', '[']).filter(|&end| end > 0).unwrap_or(name.len());
    name[..end].chars().filter(|c| c.is_alphanumeric()).flat_map(char::to_lowercase).collect()
}

/// Decodes UTF-8, or UTF-16 with a byte order mark.
fn decoded(bytes: &[u8]) -> anyhow::Result<String> {
    let utf16 = |bytes: &[u8], of: fn([u8; 2]) -> u16| {
        let units: Vec<u16> = bytes.chunks_exact(2).map(|pair| of([pair[0], pair[1]])).collect();
        String::from_utf16(&units).context("the table is not valid UTF-16; save it as UTF-8")
    };
    match bytes {
        [0xFF, 0xFE, rest @ ..] => utf16(rest, u16::from_le_bytes),
        [0xFE, 0xFF, rest @ ..] => utf16(rest, u16::from_be_bytes),
        _ => {
            let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
            let text = std::str::from_utf8(bytes).map_err(|error| {
                let line =
                    bytes[..error.valid_up_to()].iter().filter(|&&byte| byte == b'\n').count();
                anyhow::anyhow!("line {} is not valid UTF-8; save the table as UTF-8", line + 1)
            })?;
            Ok(text.to_owned())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(bytes: &[u8]) -> anyhow::Result<Table> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        Table::read(file.path(), |name| name == "file")
    }

    fn assert_table(bytes: &[u8]) {
        let table = table(bytes).unwrap();
        let text = String::from_utf8_lossy(bytes);
        assert_eq!(
            table.header.iter().map(|name| plain(name)).collect::<Vec<_>>(),
            ["file", "x", "y"],
            "{text}"
        );
        let rows: Vec<Vec<&str>> =
            table.rows.iter().map(|row| row.cells.iter().map(String::as_str).collect()).collect();
        assert_eq!(rows, [["a b.jpg", "1", "2"], ["c.jpg", "3", ""]], "{text}");
    }

    #[test]
    fn every_dialect_of_a_table_is_read() {
        for text in [
            "file,x,y\na b.jpg,1,2\nc.jpg,3,\n",
            "file,x,y\r\na b.jpg,1,2\r\nc.jpg,3\r\n",
            "file,x,y\ra b.jpg,1,2\rc.jpg,3",
            "\n\n  \nfile , x, y \n\n\"a b.jpg\" , 1, 2\n\nc.jpg,3,,\n",
            "\u{feff}File;X;Y\na b.jpg;1;2\nc.jpg;3;\n",
            "sep=;\nfile;x;y\na b.jpg;1;2\nc.jpg;3;\n",
            "FILE\tx\ty\na b.jpg\t1\t2\nc.jpg\t3\n",
            "file|x|y\na b.jpg|1|2\nc.jpg|3|\n",
            "# made by hand\nfile,x,y\n# in between\na b.jpg,1,2\nc.jpg,3,\n# end",
            "# made by hand\n#file,X (m),y [m]\na b.jpg,1,2\nc.jpg,3,\n",
            "\"file\",\"x\",\"y\"\n\"a b.jpg\",\"1\",\"2\"\n\"c.jpg\",\"3\",\"\"\n",
        ] {
            assert_table(text.as_bytes());
        }
        let text = "\u{feff}file\tx\ty\r\na b.jpg\t1\t2\r\nc.jpg\t3\t\r\n";
        assert_table(&text.encode_utf16().flat_map(u16::to_le_bytes).collect::<Vec<u8>>());
        assert_table(&text.encode_utf16().flat_map(u16::to_be_bytes).collect::<Vec<u8>>());
    }

    #[test]
    fn a_row_has_the_number_of_its_line() {
        let table = table(b"# one\n\nfile,x\n# four\na,1\n\n\"b\nc\",2\nd,3\n").unwrap();
        let lines = |table: &Table| table.rows.iter().map(|row| row.line).collect::<Vec<_>>();
        assert_eq!(lines(&table), [5, 7, 9]);
        let table = self::table(b"file,x\r\r# three\ra,1\rb,2\r").unwrap();
        assert_eq!(lines(&table), [4, 5]);
    }

    #[test]
    fn what_is_no_table_is_refused_with_the_reason() {
        let refused = |bytes: &[u8]| format!("{:#}", table(bytes).unwrap_err());
        assert!(refused(b"").contains("no row of column names"));
        assert!(refused(b"# only this\n").contains("no row of column names"));
        assert!(refused(b"file,x\na,1\ncaf\xE9,2\n").contains("line 3 is not valid UTF-8"));
        let commas = refused(b"file,lat,lon\na.jpg,45,5,-30,25\n");
        assert!(
            commas.contains("line 2 has 5 cells") && commas.contains("decimal commas"),
            "{commas}"
        );
        let folder = tempfile::tempdir().unwrap();
        assert!(Table::read(folder.path(), |_| true).is_err());
    }
}
