//! Reduction of deep pictures to 8 bits a sample.
//!
//! Industrial cameras deliver 10, 12 or 14 bits in samples of 16 bits. Divided by 256, such a picture would be
//! nearly black, for people and for models. The number of bits that are in use is therefore read from the
//! samples, and the picture is scaled to what a camera with 8 bits would have delivered.

use image::{DynamicImage, ImageBuffer, Luma, LumaA, Pixel, Rgb, RgbImage, Rgba};

/// The depths of sensors in bits.
const DEPTHS: [u32; 5] = [8, 10, 12, 14, 16];

/// Converts to RGB with 8 bits a sample. `is_full_scale` says that the decoder already scaled the samples to the
/// range of their type, so that a dark picture is dark.
pub(super) fn to_rgb8(picture: DynamicImage, is_full_scale: bool) -> RgbImage {
    let scale = |histogram: Histogram| match is_full_scale {
        true => Scale { low: 0, high: u16::MAX },
        false => Scale::of(&histogram),
    };
    match picture {
        DynamicImage::ImageLuma16(pixels) => {
            reduced(&pixels, scale, |p: &Luma<u16>| [p[0], p[0], p[0]])
        }
        DynamicImage::ImageLumaA16(pixels) => {
            reduced(&pixels, scale, |p: &LumaA<u16>| [p[0], p[0], p[0]])
        }
        DynamicImage::ImageRgb16(pixels) => reduced(&pixels, scale, |p: &Rgb<u16>| p.0),
        DynamicImage::ImageRgba16(pixels) => {
            reduced(&pixels, scale, |p: &Rgba<u16>| [p[0], p[1], p[2]])
        }
        other => other.into_rgb8(),
    }
}

fn reduced<P: Pixel<Subpixel = u16>>(
    pixels: &ImageBuffer<P, Vec<u16>>,
    scale: impl FnOnce(Histogram) -> Scale,
    rgb: impl Fn(&P) -> [u16; 3],
) -> RgbImage {
    let mut histogram = Histogram(vec![0; 1 << 16]);
    for value in pixels.pixels().flat_map(&rgb) {
        histogram.0[usize::from(value)] += 1;
    }
    let table = scale(histogram).table();
    let mut reduced = RgbImage::new(pixels.width(), pixels.height());
    for (to, from) in reduced.pixels_mut().zip(pixels.pixels()) {
        to.0 = rgb(from).map(|value| table[usize::from(value)]);
    }
    reduced
}

/// How often each value occurs.
struct Histogram(Vec<u32>);

impl Histogram {
    fn max(&self) -> u16 {
        self.0.iter().rposition(|&count| count > 0).unwrap_or(0) as u16
    }

    /// The value that a share of the samples does not exceed.
    fn quantile(&self, share: f64) -> u16 {
        let total: u64 = self.0.iter().map(|&count| u64::from(count)).sum();
        let (mut left, wanted) = (0, (total as f64 * share) as u64);
        let position = self.0.iter().position(|&count| {
            left += u64::from(count);
            left > wanted
        });
        position.unwrap_or(0) as u16
    }
}

/// The values that become black and white.
#[derive(Debug, PartialEq)]
struct Scale {
    low: u16,
    high: u16,
}

impl Scale {
    /// The range of the smallest depth that holds every sample. Thermal cameras use a narrow band far from zero
    /// of that range; 8 bits would leave a handful of grey levels, so the band itself is the range then.
    fn of(histogram: &Histogram) -> Self {
        let max = histogram.max();
        let bits = DEPTHS.into_iter().find(|&bits| u32::from(max) < 1 << bits).unwrap_or(16);
        let high = ((1u32 << bits) - 1) as u16;
        let (from, to) = (histogram.quantile(0.002), histogram.quantile(0.998));
        let band = to - from;
        let is_band = bits > 8 && band >= 16 && band < high / 8 && from > band;
        if is_band { Self { low: from, high: to } } else { Self { low: 0, high } }
    }

    fn table(&self) -> Vec<u8> {
        let (low, range) = (u32::from(self.low), u32::from(self.high - self.low).max(1));
        let reduce = |value: u32| {
            let above = value.saturating_sub(low).min(range);
            ((above * 255 + range / 2) / range) as u8
        };
        (0..1 << 16).map(reduce).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scale(values: impl IntoIterator<Item = u16>) -> Scale {
        let mut histogram = Histogram(vec![0; 1 << 16]);
        values.into_iter().for_each(|value| histogram.0[usize::from(value)] += 1);
        Scale::of(&histogram)
    }

    #[test]
    fn the_depth_in_use_becomes_the_range() {
        for (max, high) in [(200, 255), (900, 1023), (4095, 4095), (9000, 16383), (65000, 65535)] {
            assert_eq!(scale([0, max / 2, max]), Scale { low: 0, high }, "{max}");
        }
        // Twelve bits in the upper bits of sixteen.
        assert_eq!(scale((0..4096).map(|v| v << 4)), Scale { low: 0, high: 65535 });
        assert_eq!(scale([]), Scale { low: 0, high: 255 });
    }

    #[test]
    fn a_narrow_band_far_from_zero_is_stretched() {
        let thermal = scale(7000..8500);
        assert!((7000..7010).contains(&thermal.low) && (8490..8500).contains(&thermal.high));
        // By night most samples are near zero, and a lamp is not.
        assert_eq!(scale((0..300).chain([4000])), Scale { low: 0, high: 4095 });
        // A covered lens: nothing but noise.
        assert_eq!(scale(1000..1012), Scale { low: 0, high: 1023 });
    }

    #[test]
    fn full_scale_samples_are_divided_like_any_16_bit_picture() {
        let dark = ImageBuffer::<Luma<u16>, _>::from_fn(16, 1, |x, _| Luma([(x * 257) as u16]));
        let dark = DynamicImage::ImageLuma16(dark);
        let reduced = to_rgb8(dark.clone(), true);
        assert_eq!(reduced, dark.clone().into_rgb8());
        assert_ne!(to_rgb8(dark, false), reduced);
    }
}
