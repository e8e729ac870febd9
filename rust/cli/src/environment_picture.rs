//! Pictures of an environment's fit: radiances as EXR, colours as PNG with the map above the fit.

use std::path::Path;

use glam::DVec3;
use glints::environment_map::{EnvironmentFit, EnvironmentMap, Rgb, luminance};
use image::imageops::{self, FilterType};
use image::{ImageFormat, Rgb as Pixel, Rgb32FImage, RgbImage};
use rayon::prelude::*;

use crate::failure::{Failure, Result};
use crate::picture::{Format, srgb};

/// Most columns and rows of a picture; lobes are smooth.
const MOST: (u32, u32) = (1024, 512);

/// Rows between the map and the fit.
const GAP: u32 = 8;

/// Luminance that the mean logarithm of a picture is brought to.
const KEY: f64 = 0.18;

/// Writes radiances of the fit, for the map's orientation; or, as colours, the map and below it the fit.
pub fn write(path: &Path, format: Format, map: &EnvironmentMap, fit: &EnvironmentFit) -> Result<()> {
    let (width, height) = (map.width().min(MOST.0), map.height().min(MOST.1));
    let shown = radiances(fit, width, height)?;
    let written = match format {
        Format::Exr => shown.save_with_format(path, ImageFormat::OpenExr),
        Format::Png => colours(map, &shown).save_with_format(path, ImageFormat::Png),
    };
    written.map_err(|e| Failure::failed(format!("the picture cannot be written ({e})")))
}

fn radiances(fit: &EnvironmentFit, width: u32, height: u32) -> Result<Rgb32FImage> {
    let black = vec![[0.0; 3]; width as usize * height as usize];
    let grid = EnvironmentMap::new(width, height, black)?;
    let rows: Vec<Vec<f32>> = (0..height)
        .into_par_iter()
        .map(|row| {
            let directions = (0..width).map(|column| grid.direction(column, row));
            directions
                .flat_map(|x: DVec3| fit.radiance(x.as_vec3()).map(|c| c as f32))
                .collect()
        })
        .collect();
    Rgb32FImage::from_raw(width, height, rows.concat())
        .ok_or_else(|| Failure::failed("the picture does not fit its size"))
}

/// The map and the fit, one above the other, with the same tones: those of E. Reinhard et al., "Photographic Tone
/// Reproduction for Digital Images", 2002 (Eq. 1 to 3), as lamps are thousands of times brighter than rooms.
fn colours(map: &EnvironmentMap, fit: &Rgb32FImage) -> RgbImage {
    let exposure = KEY / mean_luminance(map);
    let (width, height) = fit.dimensions();
    let whole = RgbImage::from_fn(map.width(), map.height(), |column, row| {
        tone(map.pixel(column, row), exposure)
    });
    let above = imageops::resize(&whole, width, height, FilterType::Triangle);
    let below = RgbImage::from_fn(width, height, |column, row| {
        tone(fit.get_pixel(column, row).0.map(f64::from), exposure)
    });
    let mut picture = RgbImage::from_pixel(width, 2 * height + GAP, Pixel([245; 3]));
    imageops::replace(&mut picture, &above, 0, 0);
    imageops::replace(&mut picture, &below, 0, i64::from(height + GAP));
    picture
}

/// By logarithms and over solid angle; of pixels that have any light.
fn mean_luminance(map: &EnvironmentMap) -> f64 {
    let (mut sum, mut weights) = (0.0, 0.0);
    for row in 0..map.height() {
        let weight = map.solid_angle(row);
        let lit = (0..map.width())
            .map(|column| luminance(map.pixel(column, row)))
            .filter(|&l| l > 0.0);
        for luminance in lit {
            sum += weight * luminance.ln();
            weights += weight;
        }
    }
    (sum / weights).exp()
}

fn tone(radiance: Rgb, exposure: f64) -> Pixel<u8> {
    let compressed = 1.0 + exposure * luminance(radiance);
    Pixel(radiance.map(|c| srgb((exposure * c / compressed) as f32)))
}
