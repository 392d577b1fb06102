//! The natural order of names: `2.jpg` before `10.jpg`.

use std::cmp::Ordering;

/// Compares two relative paths folder by folder; runs of digits compare as numbers. Names that differ only in
/// leading zeros are ordered by their bytes.
pub(super) fn compare(a: &str, b: &str) -> Ordering {
    let mut parts = (a.split('/'), b.split('/'));
    loop {
        match (parts.0.next(), parts.1.next()) {
            (None, None) => return a.cmp(b),
            (None, Some(_)) => return Ordering::Less,
            (Some(_), None) => return Ordering::Greater,
            (Some(a), Some(b)) => match compare_names(a.as_bytes(), b.as_bytes()) {
                Ordering::Equal => {}
                unequal => return unequal,
            },
        }
    }
}

fn compare_names(mut a: &[u8], mut b: &[u8]) -> Ordering {
    loop {
        let digits = |text: &[u8]| text.iter().take_while(|byte| byte.is_ascii_digit()).count();
        let order = match (digits(a), digits(b)) {
            (0, _) | (_, 0) => match (a.split_first(), b.split_first()) {
                (None, None) => return Ordering::Equal,
                (None, Some(_)) => return Ordering::Less,
                (Some(_), None) => return Ordering::Greater,
                (Some((first, rest)), Some((other, others))) => {
                    (a, b) = (rest, others);
                    first.cmp(other)
                }
            },
            (in_a, in_b) => {
                let (number, rest) = a.split_at(in_a);
                let (other, others) = b.split_at(in_b);
                (a, b) = (rest, others);
                let (number, other) = (without_zeros(number), without_zeros(other));
                number.len().cmp(&other.len()).then_with(|| number.cmp(other))
            }
        };
        if order != Ordering::Equal {
            return order;
        }
    }
}

fn without_zeros(digits: &[u8]) -> &[u8] {
    let zeros = digits.iter().take_while(|&&digit| digit == b'0').count();
    &digits[zeros..]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_names_compare_as_numbers() {
        let sorted = [
            "",
            "1.jpg",
            "01.jpg",
            "2.jpg",
            "10.jpg",
            "a/2.jpg",
            "a/10.jpg",
            "a.jpg",
            "a1b2.jpg",
            "a1b10.jpg",
            "a2.jpg",
            "a10/1.jpg",
            "b.jpg",
            "frame-9.jpg",
            "frame-10.jpg",
            "frame-123456789012345678901234567890.jpg",
            "ä1.jpg",
        ];
        for (index, a) in sorted.iter().enumerate() {
            for (other, b) in sorted.iter().enumerate() {
                if ["1.jpg", "01.jpg"].contains(a) && ["1.jpg", "01.jpg"].contains(b) {
                    continue;
                }
                assert_eq!(compare(a, b), index.cmp(&other), "{a} {b}");
            }
        }
        assert_eq!(compare("01.jpg", "1.jpg"), compare("1.jpg", "01.jpg").reverse());
        assert_ne!(compare("01.jpg", "1.jpg"), Ordering::Equal);
    }
}
