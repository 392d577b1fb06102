//! The account of a folder in lines for people: every list says how many there are, and names the first of them.

use super::SkippedFile;
use whereabouts_core::ImageId;

/// Lists the first names, and says how many there are if not all are listed.
pub fn bounded<T>(all: &[T], most: usize, name: impl Fn(&T) -> String) -> String {
    let mut text = all.iter().take(most).map(name).collect::<Vec<_>>().join(", ");
    if all.len() > most {
        text.push_str(&format!(" and {} more", all.len() - most));
    }
    text
}

/// One line for each skipped file, and one for those that are not listed.
pub fn skipped_lines(skipped: &[SkippedFile], most: usize) -> Vec<String> {
    let line = |one: &SkippedFile| format!("skipped {}: {}", one.file, one.why);
    let mut lines: Vec<String> = skipped.iter().take(most).map(line).collect();
    if skipped.len() > most {
        lines.push(format!("skipped {} more", skipped.len() - most));
    }
    lines
}

/// One line for each distinct warning, with its images.
pub fn warning_lines(warnings: &[(ImageId, String)], most: usize) -> Vec<String> {
    let mut by_text: Vec<(&str, Vec<&ImageId>)> = Vec::new();
    for (id, text) in warnings {
        match by_text.iter_mut().find(|(other, _)| other == text) {
            Some((_, ids)) => ids.push(id),
            None => by_text.push((text, vec![id])),
        }
    }
    let line = |(text, ids): &(&str, Vec<&ImageId>)| {
        format!("{text} ({}): {}", ids.len(), bounded(ids, most, |id| id.to_string()))
    };
    let mut lines: Vec<String> = by_text.iter().take(most).map(line).collect();
    if by_text.len() > most {
        lines.push(format!("other warnings ({})", by_text.len() - most));
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lists_are_bounded_and_their_number_is_given() {
        assert_eq!(bounded(&[1, 2, 3], 3, i32::to_string), "1, 2, 3");
        assert_eq!(bounded(&[1, 2, 3], 2, i32::to_string), "1, 2 and 1 more");
        let skipped =
            |file: &str| SkippedFile { file: file.into(), why: "cut".into(), is_lost: true };
        let lines = skipped_lines(&[skipped("a"), skipped("b")], 1);
        assert_eq!(lines, ["skipped a: cut", "skipped 1 more"]);
        let warning = |id: &str, text: &str| (id.parse().unwrap(), text.to_owned());
        let lines = warning_lines(&[warning("a", "x"), warning("b", "y"), warning("c", "x")], 1);
        assert_eq!(lines, ["x (2): a and 1 more", "other warnings (1)"]);
    }
}
