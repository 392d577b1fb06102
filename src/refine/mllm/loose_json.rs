//! Reads JSON as models write it: inside prose, with raw line breaks, unescaped or single quotes, comments,
//! trailing or missing commas, and bare words.

/// A value. Objects keep the order of their members.
#[derive(Debug, Clone, PartialEq)]
pub enum Loose {
    /// `null`, or Python's `None`.
    Null,
    /// A truth value.
    Bool(bool),
    /// A number.
    Number(f64),
    /// A string or a bare word.
    Text(String),
    /// A list.
    List(Vec<Loose>),
    /// An object.
    Object(Vec<(String, Loose)>),
}

/// A value and where it ends in the text.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundValue {
    /// The value.
    pub value: Loose,
    /// The byte after it.
    pub end: usize,
}

/// How deep values may be nested.
const MAX_DEPTH: usize = 24;

/// How many characters are read in all, which bounds the work on hostile texts.
const MAX_STEPS: usize = 4 << 20;

/// The longest bare word, in characters.
const LONGEST_WORD: usize = 200;

/// Finds the outermost objects and lists of a text, in order.
pub fn values(text: &str) -> Vec<FoundValue> {
    let mut reader = Reader { text, at: 0, steps: MAX_STEPS };
    let mut found = Vec::new();
    let mut from = 0;
    while let Some(start) = text[from..].find(['{', '[']).map(|at| from + at) {
        reader.at = start;
        match reader.value(0) {
            Some(value) => {
                from = reader.at;
                found.push(FoundValue { value, end: from });
            }
            None if reader.steps == 0 => break,
            None => from = start + 1,
        }
    }
    found
}

/// Reads the list or object at the start of a text.
pub fn value_at(text: &str) -> Option<Loose> {
    Reader { text, at: 0, steps: MAX_STEPS }.value(0)
}

struct Reader<'a> {
    text: &'a str,
    at: usize,
    steps: usize,
}

impl Reader<'_> {
    fn peek(&self) -> Option<char> {
        self.text[self.at..].chars().next()
    }

    fn next(&mut self) -> Option<char> {
        self.steps = self.steps.checked_sub(1)?;
        let c = self.peek()?;
        self.at += c.len_utf8();
        Some(c)
    }

    /// Skips a character if it is next.
    fn eat(&mut self, wanted: char) -> bool {
        self.blank();
        let is_next = self.peek() == Some(wanted);
        if is_next {
            self.at += wanted.len_utf8();
        }
        is_next
    }

    /// Skips white space and comments.
    fn blank(&mut self) {
        while self.steps > 0 {
            let rest = &self.text[self.at..];
            let trimmed = rest.trim_start();
            let comment = match trimmed.get(..2) {
                Some("//") => trimmed.find('\n').unwrap_or(trimmed.len()),
                Some("/*") => trimmed.find("*/").map_or(trimmed.len(), |end| end + 2),
                _ => 0,
            };
            let skipped = rest.len() - trimmed.len() + comment;
            self.at += skipped;
            self.steps = self.steps.saturating_sub(skipped);
            if comment == 0 {
                return;
            }
        }
    }

    fn value(&mut self, depth: usize) -> Option<Loose> {
        self.blank();
        if depth > MAX_DEPTH {
            return None;
        }
        match self.peek()? {
            '{' => self.object(depth),
            '[' => self.list(depth),
            quote if closing_quote(quote).is_some() => self.quoted().map(Loose::Text),
            _ => self.word(),
        }
    }

    fn object(&mut self, depth: usize) -> Option<Loose> {
        self.next()?;
        let mut members = Vec::new();
        loop {
            if self.eat('}') {
                return Some(Loose::Object(members));
            }
            // A text that ends after a member lacks only the brace.
            if self.peek().is_none() && !members.is_empty() {
                return Some(Loose::Object(members));
            }
            let key = match self.peek()? {
                quote if closing_quote(quote).is_some() => self.quoted()?,
                _ => self.key()?,
            };
            if !self.eat(':') {
                return None;
            }
            members.push((key, self.value(depth + 1)?));
            self.eat(',');
        }
    }

    fn list(&mut self, depth: usize) -> Option<Loose> {
        self.next()?;
        let mut items = Vec::new();
        loop {
            if self.eat(']') {
                return Some(Loose::List(items));
            }
            items.push(self.value(depth + 1)?);
            self.eat(',');
        }
    }

    /// Reads a key without quotes.
    fn key(&mut self) -> Option<String> {
        let start = self.at;
        while self.peek().is_some_and(|c| c.is_alphanumeric() || c == '_' || c == '-') {
            self.next()?;
        }
        (self.at > start).then(|| self.text[start..self.at].to_owned())
    }

    /// Reads a number, a constant or a bare word, which ends with its line.
    fn word(&mut self) -> Option<Loose> {
        let start = self.at;
        while self.peek().is_some_and(|c| !matches!(c, ',' | ']' | '}' | '{' | '[' | '\n' | '"')) {
            self.next()?;
            if self.at - start > LONGEST_WORD {
                return None;
            }
        }
        let word = self.text[start..self.at].trim();
        Some(match word {
            "" => return None,
            "null" | "None" | "NaN" | "nil" => Loose::Null,
            "true" | "True" => Loose::Bool(true),
            "false" | "False" => Loose::Bool(false),
            _ => match word.parse::<f64>() {
                Ok(number) if number.is_finite() => Loose::Number(number),
                _ => Loose::Text(word.to_owned()),
            },
        })
    }

    /// Reads a quoted string, whose own quotes need not be escaped: a quote ends it only where a value can end.
    fn quoted(&mut self) -> Option<String> {
        let closing = closing_quote(self.next()?)?;
        let mut text = String::new();
        loop {
            match self.next()? {
                '\\' => self.escape(&mut text)?,
                c if c == closing && self.value_may_end() => return Some(text),
                c => text.push(c),
            }
        }
    }

    /// Whether a string may end here: before a comma, a bracket, a colon, the end, or the next key on a new line.
    fn value_may_end(&self) -> bool {
        let rest = &self.text[self.at..];
        let after = rest.trim_start();
        match after.chars().next() {
            None | Some(',' | '}' | ']' | ':') => true,
            Some('"') => {
                let new_line = rest[..rest.len() - after.len()].contains('\n');
                new_line && is_key(&after[1..])
            }
            _ => false,
        }
    }

    fn escape(&mut self, text: &mut String) -> Option<()> {
        match self.next()? {
            'n' => text.push('\n'),
            't' => text.push('\t'),
            'r' => text.push('\r'),
            'b' | 'f' => {}
            'u' => text.push(self.code_point()),
            c => text.push(c),
        }
        Some(())
    }

    /// Reads the digits of `\uXXXX`, of which a pair may encode one character.
    fn code_point(&mut self) -> char {
        let mut units = Vec::new();
        while units.len() < 2 {
            let digits = self.text.get(self.at..self.at + 4);
            let Some(unit) = digits.and_then(|digits| u16::from_str_radix(digits, 16).ok()) else {
                break;
            };
            self.at += 4;
            units.push(unit);
            let is_high = (0xd800..0xdc00).contains(&unit);
            if !is_high || self.text.get(self.at..self.at + 2) != Some("\\u") {
                break;
            }
            self.at += 2;
        }
        char::decode_utf16(units).next().and_then(Result::ok).unwrap_or(char::REPLACEMENT_CHARACTER)
    }
}

fn closing_quote(opening: char) -> Option<char> {
    match opening {
        '"' | '\'' | '`' => Some(opening),
        '“' | '„' => Some('”'),
        '‘' => Some('’'),
        _ => None,
    }
}

/// Whether the text inside and after a quote is a key.
fn is_key(after_quote: &str) -> bool {
    let Some((key, rest)) = after_quote.split_once('"') else { return false };
    let plain = key.chars().all(|c| c.is_alphanumeric() || c == '_' || c == '-');
    plain && !key.is_empty() && rest.trim_start().starts_with(':')
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(text: &str) -> Loose {
        Loose::Text(text.into())
    }

    fn one(json: &str) -> Loose {
        let mut found = values(json);
        assert_eq!(found.len(), 1, "{json}: {found:?}");
        found.remove(0).value
    }

    #[test]
    fn what_models_write_is_read() {
        let wanted = Loose::Object(vec![
            ("a".into(), text("x \"y\"\nz")),
            ("b".into(), Loose::List(vec![text("A"), Loose::Number(2.0)])),
        ]);
        for json in [
            r#"{"a": "x \"y\"\nz", "b": ["A", 2]}"#,
            "{\"a\": \"x \"y\"\nz\", \"b\": [\"A\", 2,],}",
            "so {'a': 'x \"y\"\nz', 'b': ['A', 2]} it is",
            "{a: \"x \\\"y\\\"\\nz\", // why\n b: [A, 2]}",
            "{“a”: “x \"y\"\nz”, “b”: [“A”, 2]}",
            "{\"a\": \"x \"y\"\nz\"\n\"b\": [\"A\" 2",
        ] {
            if json.ends_with('2') {
                assert_eq!(values(json), [], "a list that does not end is no list");
                continue;
            }
            assert_eq!(one(json), wanted, "{json}");
        }
    }

    #[test]
    fn values_are_found_in_prose_in_their_order() {
        let found = values("Not {this}, but {\"a\": 1} and [A, B]. {\"a\": ");
        let found: Vec<Loose> = found.into_iter().map(|found| found.value).collect();
        let a = Loose::Object(vec![("a".into(), Loose::Number(1.0))]);
        assert_eq!(found, [a, Loose::List(vec![text("A"), text("B")])]);
        assert_eq!(one(r#"["\ud83d\ude00"]"#), Loose::List(vec![text("😀")]));
    }

    #[test]
    fn hostile_texts_end() {
        for text in ["{".repeat(200_000), "[".repeat(200_000), "{\"a\":\"".repeat(50_000)] {
            values(&text);
        }
    }
}
