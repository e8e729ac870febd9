//! Pictures of distributions of normals: raw values as EXR, colours as PNG.

use std::path::Path;

use image::{ImageFormat, Rgb, Rgb32FImage, RgbImage};

use crate::failure::{Failure, Result};

/// The logarithmic scale of colours spans this many powers of ten below the peak.
pub const DECADES: f32 = 5.0;

/// Pixels between the panels and around them, and width of the bar of colours.
const MARGIN: u32 = 12;
const BAR: u32 = 16;

const PAGE: Rgb<u8> = Rgb([245, 245, 245]);
const LINE: Rgb<u8> = Rgb([120, 120, 120]);

/// What a picture is written as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    Png,
    Exr,
}

impl Format {
    /// By the file name's extension.
    pub fn of(path: &Path) -> Result<Self> {
        let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
        match extension.to_str() {
            Some("png") => Ok(Self::Png),
            Some("exr") => Ok(Self::Exr),
            _ => Err(Failure::usage(format!(
                "\"{}\": a picture is written as .png (colours) or .exr (values); end the name with one of them",
                path.display()
            ))),
        }
    }
}

/// Writes square panels of values `size * size`, side by side: as they are, or on a common scale of colours
/// that ends at `peak`.
pub fn write(path: &Path, format: Format, panels: &[&[f32]], size: u32, peak: f32) -> Result<()> {
    let written = match format {
        Format::Exr => values(panels, size).save_with_format(path, ImageFormat::OpenExr),
        Format::Png => colours(panels, size, peak).save_with_format(path, ImageFormat::Png),
    };
    written.map_err(|e| Failure::failed(format!("the picture cannot be written ({e})")))
}

fn values(panels: &[&[f32]], size: u32) -> Rgb32FImage {
    Rgb32FImage::from_fn(size * panels.len() as u32, size, |x, y| {
        Rgb([panels[(x / size) as usize][(y * size + x % size) as usize]; 3])
    })
}

/// Panels with the circle of the horizon, and the scale to their right, with a notch every power of ten below
/// the peak.
fn colours(panels: &[&[f32]], size: u32, peak: f32) -> RgbImage {
    let count = panels.len() as u32;
    let width = count * (size + MARGIN) + MARGIN + BAR + MARGIN;
    let mut picture = RgbImage::from_pixel(width, size + 2 * MARGIN, PAGE);
    for (index, panel) in (0..count).zip(panels) {
        let left = MARGIN + index * (size + MARGIN);
        for (x, y) in (0..size).flat_map(|y| (0..size).map(move |x| (x, y))) {
            let value = panel[(y * size + x) as usize];
            if let Some(colour) = pixel_colour(x, y, size, value / peak) {
                picture.put_pixel(left + x, MARGIN + y, colour);
            }
        }
    }
    draw_scale(&mut picture, width - MARGIN - BAR, size);
    picture
}

/// Colour of a pixel of a panel: inside the horizon, on its circle, or outside.
fn pixel_colour(x: u32, y: u32, size: u32, share: f32) -> Option<Rgb<u8>> {
    let from_middle = |i: u32| i as f32 + 0.5 - 0.5 * size as f32;
    let beyond = from_middle(x).hypot(from_middle(y)) - 0.5 * size as f32;
    match beyond {
        b if b < -1.0 => Some(colour(logarithmic(share))),
        b if b < 0.5 => Some(LINE),
        _ => None,
    }
}

fn draw_scale(picture: &mut RgbImage, left: u32, size: u32) {
    for y in 0..size {
        let t = 1.0 - (y as f32 + 0.5) / size as f32;
        let below_peak = y as f32 * DECADES / size as f32;
        let notch = below_peak.fract() < DECADES / size as f32;
        for x in 0..BAR {
            let shown = if notch && x >= BAR / 2 { PAGE } else { colour(t) };
            picture.put_pixel(left + x, MARGIN + y, shown);
        }
    }
}

/// Place on the scale of a share of the peak.
fn logarithmic(share: f32) -> f32 {
    if share > 0.0 {
        (1.0 + share.log10() / DECADES).clamp(0.0, 1.0)
    } else {
        0.0
    }
}

/// A colour for t in [0, 1]: lightness grows linearly in the Oklab colour space, the hue turns from violet
/// through red to yellow (B. Ottosson, "A perceptual color space for image processing", 2020, whose matrices
/// these are).
fn colour(t: f32) -> Rgb<u8> {
    let lightness = 0.10 + 0.87 * t;
    let chroma = 0.17 * (std::f32::consts::PI * (0.12 + 0.76 * t)).sin();
    let (sin, cos) = (290.0 + 175.0 * t).to_radians().sin_cos();
    let (a, b) = (chroma * cos, chroma * sin);
    let l = (lightness + 0.396_337_78 * a + 0.215_803_76 * b).powi(3);
    let m = (lightness - 0.105_561_346 * a - 0.063_854_17 * b).powi(3);
    let s = (lightness - 0.089_484_18 * a - 1.291_485_5 * b).powi(3);
    Rgb([
        4.076_741_7 * l - 3.307_711_6 * m + 0.230_969_94 * s,
        -1.268_438 * l + 2.609_757_4 * m - 0.341_319_38 * s,
        -0.004_196_086_3 * l - 0.703_418_6 * m + 1.707_614_7 * s,
    ]
    .map(srgb))
}

/// The transfer function of sRGB (IEC 61966-2-1), to 8 bits.
pub fn srgb(linear: f32) -> u8 {
    let linear = linear.clamp(0.0, 1.0);
    let encoded = if linear <= 0.003_130_8 {
        12.92 * linear
    } else {
        1.055 * linear.powf(1.0 / 2.4) - 0.055
    };
    (255.0 * encoded).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_grow_lighter() {
        let luminance = |t: f32| {
            let Rgb([r, g, b]) = colour(t);
            0.2126 * f32::from(r) + 0.7152 * f32::from(g) + 0.0722 * f32::from(b)
        };
        for i in 0..32 {
            let t = i as f32 / 32.0;
            assert!(luminance(t + 1.0 / 32.0) > luminance(t), "{t}");
        }
    }

    #[test]
    fn the_scale_ends_at_the_peak() {
        assert_eq!(logarithmic(1.0), 1.0);
        assert_eq!(logarithmic(0.0), 0.0);
        assert_eq!(logarithmic(1e-9), 0.0);
        assert!((logarithmic(0.1) - 0.8).abs() < 1e-6);
    }
}
