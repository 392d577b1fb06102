//! Numbers, coordinates and lengths as people and programs write them into tables. What can be read in two ways is
//! refused.

/// Words of programs for a value that is not known.
const NOTHING: [&str; 9] = ["", "nan", "null", "none", "na", "n/a", "-", "undef", "unknown"];

/// A coordinate, and the words for the sides of its zero.
#[derive(Debug)]
pub(super) struct Axis {
    name: &'static str,
    positive: [&'static str; 2],
    negative: [&'static str; 2],
}

pub(super) const LATITUDE: Axis =
    Axis { name: "latitude", positive: ["n", "north"], negative: ["s", "south"] };
pub(super) const LONGITUDE: Axis =
    Axis { name: "longitude", positive: ["e", "east"], negative: ["w", "west"] };

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Side {
    Positive,
    Negative,
}

impl Axis {
    fn side(&self, word: &str) -> Option<Side> {
        let is = |words: &[&str]| words.iter().any(|one| word.trim().eq_ignore_ascii_case(one));
        if is(&self.positive) {
            Some(Side::Positive)
        } else {
            is(&self.negative).then_some(Side::Negative)
        }
    }
}

/// Parses a number with a decimal point or comma; `None` for an empty cell and for what programs write instead.
pub(super) fn number(text: &str) -> Result<Option<f64>, ()> {
    let text = text.trim_matches(|c: char| c.is_whitespace() || c == '\u{b0}');
    if NOTHING.iter().any(|nothing| text.eq_ignore_ascii_case(nothing)) {
        return Ok(None);
    }
    let mut text = text.replace('\u{2212}', "-");
    if text.matches(',').count() == 1 && !text.contains('.') {
        text = text.replace(',', ".");
    }
    text.parse().ok().filter(|value: &f64| value.is_finite()).map(Some).ok_or(())
}

/// Parses a coordinate in signed degrees, or in degrees, minutes and seconds with a hemisphere, such as
/// `52 deg 13' 30.00" N`. The hemisphere may be in a cell of its own, `reference`.
pub(super) fn coordinate(text: &str, reference: &str, axis: &Axis) -> Result<Option<f64>, String> {
    let name = axis.name;
    let reference = axis.side(reference);
    let (degrees, side) = match number(text) {
        Ok(None) => return Ok(None),
        Ok(Some(degrees)) => (Degrees { degrees, is_signed: true }, reference),
        Err(()) => {
            let (rest, side) = without_side(text, axis).ok_or_else(|| {
                format!("{text:?} is not a number, nor a {name} such as {EXAMPLE}")
            })?;
            let degrees = Degrees::parse(rest, side.is_some()).ok_or_else(|| {
                format!("{text:?} is not a number, nor clearly a {name} such as {EXAMPLE}")
            })?;
            if side.is_some() && reference.is_some_and(|reference| Some(reference) != side) {
                return Err(format!("{text:?} contradicts the hemisphere in another column"));
            }
            (degrees, side.or(reference))
        }
    };
    let Degrees { degrees, is_signed } = degrees;
    match side {
        Some(Side::Negative) => Ok(Some(-degrees.abs())),
        Some(Side::Positive) if degrees < 0.0 => Err(format!(
            "the {name} {text:?} is negative, which contradicts its hemisphere {:?}",
            axis.positive[0].to_ascii_uppercase()
        )),
        Some(Side::Positive) => Ok(Some(degrees)),
        None if is_signed => Ok(Some(degrees)),
        None => Err(format!(
            "the {name} {text:?} has no hemisphere; write it behind the seconds ({EXAMPLE}), or as signed degrees \
             (exiftool -n)"
        )),
    }
}

const EXAMPLE: &str = "52.225 or 52 deg 13' 30\" N";

/// Takes the hemisphere from the beginning or the end of a coordinate.
fn without_side<'a>(text: &'a str, axis: &Axis) -> Option<(&'a str, Option<Side>)> {
    let text = text.trim();
    let is_letter = |c: char| c.is_alphabetic() && c != '\u{ba}';
    let behind = text.trim_end_matches(is_letter);
    let (last, before) = (&text[behind.len()..], text.trim_start_matches(is_letter));
    let first = &text[..text.len() - before.len()];
    match (first, last) {
        ("", "") => Some((text, None)),
        ("", last) if last.eq_ignore_ascii_case("deg") => Some((behind, None)),
        ("", last) => Some((behind, Some(axis.side(last)?))),
        (first, "") => Some((before, Some(axis.side(first)?))),
        _ => None,
    }
}

/// An angle, and whether one knows its sign.
struct Degrees {
    degrees: f64,
    is_signed: bool,
}

impl Degrees {
    /// Parses one to three numbers with or without their units.
    fn parse(text: &str, has_side: bool) -> Option<Self> {
        let text = text.trim().replace("deg", "\u{b0}");
        let unsigned = text.trim_start_matches(['-', '+', '\u{2212}']);
        let sign = &text[..text.len() - unsigned.len()];
        if !["", "-", "+", "\u{2212}"].contains(&sign) {
            return None;
        }
        let is_digit = |c: char| c.is_ascii_digit() || c == '.' || c == ',';
        let is_unit = |c: char| {
            c.is_whitespace()
                || "\u{b0}\u{ba}\u{2da}'\u{2032}\u{2019}`\"\u{2033}\u{201d}:".contains(c)
        };
        if !unsigned.chars().all(|c| is_digit(c) || is_unit(c)) {
            return None;
        }
        let has_units = unsigned.contains(is_unit);
        let (commas, has_point) = (unsigned.matches(',').count(), unsigned.contains('.'));
        let is_decimal = commas == 1 && !has_point;
        let digits_behind = unsigned.rsplit(',').next().map_or(0, str::len);
        let numbers: Vec<&str> = match (has_units, is_decimal) {
            // 52,30N may be degrees and minutes, or degrees with decimals.
            (false, true) if has_side && digits_behind <= 2 => return None,
            (true, _) | (_, true) => unsigned.split(is_unit).collect(),
            (false, false) => unsigned.split(',').collect(),
        };
        let numbers: Vec<f64> = numbers
            .into_iter()
            .filter(|number| !number.trim_matches(',').is_empty())
            .map(|number| number.trim_matches(',').replace(',', ".").parse().ok())
            .collect::<Option<_>>()?;
        let (last, whole) = numbers.split_last()?;
        let is_whole = whole.iter().all(|number| number.fract() == 0.0);
        // Seconds may have been rounded up.
        let is_in_range = numbers.iter().skip(1).all(|number| *number <= 60.0);
        if !(is_whole && is_in_range && whole.len() <= 2 && last.is_finite()) {
            return None;
        }
        let degrees: f64 =
            numbers.iter().zip([1.0, 60.0, 3600.0]).map(|(number, unit)| number / unit).sum();
        let is_negative = !["", "+"].contains(&sign);
        let is_signed = numbers.len() == 1 || !sign.is_empty();
        Some(Self { degrees: if is_negative { -degrees } else { degrees }, is_signed })
    }
}

/// Parses an altitude in metres, such as `240.5 m Below Sea Level`.
pub(super) fn length(text: &str, reference: &str) -> Result<Option<f64>, ()> {
    let lower = text.trim().to_ascii_lowercase();
    let ends = [" above sea level", " below sea level"];
    let end = ends.iter().find(|end| lower.ends_with(**end));
    let value = end.map_or(lower.as_str(), |end| &lower[..lower.len() - end.len()]).trim_end();
    let units = ["metres", "meters", "m"];
    let unit = units.iter().find(|unit| value.ends_with(**unit));
    let value = unit.map_or(value, |unit| &value[..value.len() - unit.len()]);
    let reference = reference.trim().to_ascii_lowercase();
    let is_below = end == Some(&ends[1])
        || reference.starts_with("below")
        || reference.starts_with("negative")
        || ["1", "3"].contains(&reference.as_str());
    Ok(number(value)?.map(|value| if is_below { -value.abs() } else { value }))
}

/// Splits a cell with a latitude and a longitude.
pub(super) fn pair(text: &str) -> Option<(&str, &str)> {
    let text = text.trim().trim_matches(['(', ')', '[', ']']);
    for separator in [";", ", ", ","] {
        if text.matches(separator).count() == 1 {
            return text.split_once(separator);
        }
    }
    let mut words = text.split_whitespace();
    let (lat, lon) = (words.next()?, words.next()?);
    words.next().is_none().then_some((lat, lon))
}
