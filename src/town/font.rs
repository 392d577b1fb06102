//! A stroke font for signs: capitals, digits, `&` and `'`.
//!
//! Glyphs are polylines on a grid 4 wide and 6 tall, so a sign is sharp at any distance and its
//! edges can be filtered analytically.

/// Space between glyphs and height of a capital, in grid units.
const GAP: f32 = 1.9;
const CAPITAL: f32 = 6.0;

/// Half the stroke thickness, in grid units.
const PEN: f32 = 0.52;

/// Polylines of a glyph: each pair of digits is a point `xy`, a space lifts the pen.
fn strokes(glyph: u8) -> &'static str {
    match glyph {
        b'A' => "002640 1232",
        b'B' => "00063645443303 3342413000",
        b'C' => "4536160501103041",
        b'D' => "00062644422000",
        b'E' => "46060040 0333",
        b'F' => "460600 0333",
        b'G' => "45361605011030414323",
        b'H' => "0006 4046 0343",
        b'I' => "0006",
        b'J' => "4641301001",
        b'K' => "0006 4602 1340",
        b'L' => "060040",
        b'M' => "0006234640",
        b'N' => "00064046",
        b'O' | b'0' => "103041453616050110",
        b'P' => "00063645443303",
        b'Q' => "103041453616050110 2240",
        b'R' => "00063645443303 2340",
        b'S' => "453616050413334241301001",
        b'T' => "0646 2620",
        b'U' => "060110304146",
        b'V' => "062046",
        b'W' => "0610233046",
        b'X' => "0046 0640",
        b'Y' => "062346 2320",
        b'Z' => "06460040",
        b'1' => "051610",
        b'2' => "05163645440040",
        b'3' => "05163645443313 334241301001",
        b'4' => "30360242",
        b'5' => "460603334241301001",
        b'6' => "4536160501103041423303",
        b'7' => "064610",
        b'8' => "13334445361605041302011030414233",
        b'9' => "0110304145361605041343",
        b'&' => "400405162635340201102042",
        b'\'' => "0604",
        _ => "",
    }
}

fn glyph_width(glyph: u8) -> f32 {
    match glyph {
        b'I' | b'\'' => 0.0,
        b'1' => 1.0,
        b' ' => 1.4,
        _ => 4.0,
    }
}

/// Width of a line of text per unit of capital height.
pub(super) fn text_width(text: &str) -> f32 {
    let advance: f32 = text.bytes().map(|glyph| glyph_width(glyph) + GAP).sum();
    (advance - GAP).max(0.0) / CAPITAL
}

/// How much of a pixel at `(x, y)` is ink, in `0.0..=1.0`, for text whose first capital has its
/// lower left corner at the origin. Lengths are in units of the capital height; `blur` is the
/// pixel's extent.
pub(super) fn ink(text: &str, x: f32, y: f32, blur: f32) -> f32 {
    let (x, y, blur) = (x * CAPITAL, y * CAPITAL, (blur * CAPITAL).max(1e-3));
    let mut start = 0.0;
    for glyph in text.bytes() {
        let end = start + glyph_width(glyph);
        if x < end + GAP / 2.0 {
            let distance = stroke_distance(strokes(glyph), x - start, y);
            // A stroke thinner than the pixel can never cover all of it.
            let most = (2.0 * PEN / blur).min(1.0);
            return ((PEN - distance) / blur + 0.5).clamp(0.0, most);
        }
        start = end + GAP;
    }
    0.0
}

fn stroke_distance(strokes: &str, x: f32, y: f32) -> f32 {
    let mut nearest = f32::INFINITY;
    for line in strokes.split(' ') {
        let mut points = line.as_bytes().chunks_exact(2).map(grid_point);
        let Some(mut from) = points.next() else {
            continue;
        };
        for to in points {
            nearest = nearest.min(segment_distance_squared(from, to, (x, y)));
            from = to;
        }
    }
    nearest.sqrt()
}

fn grid_point(digits: &[u8]) -> (f32, f32) {
    let digit = |index: usize| f32::from(digits[index] - b'0');
    (digit(0), digit(1))
}

fn segment_distance_squared(from: (f32, f32), to: (f32, f32), point: (f32, f32)) -> f32 {
    let (dx, dy) = (to.0 - from.0, to.1 - from.1);
    let (px, py) = (point.0 - from.0, point.1 - from.1);
    let share = ((px * dx + py * dy) / (dx * dx + dy * dy)).clamp(0.0, 1.0);
    let (ex, ey) = (px - share * dx, py - share * dy);
    ex * ex + ey * ey
}
