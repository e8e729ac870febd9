//! Interpolated maps for methods that know one normal a texel: the surface of curved elements (Yan et al. 2016),
//! resampled until the steps between texels are small against a flake's lobe.
//!
//! **Surface** Projected normals, bilinear between the centres of texels, with repetition:
//! [`NormalMap::interpolated`]. It is what curved elements of [`crate::methods::yan16`] tend to, and what
//! [`crate::methods::unfiltered`] shows. [`NormalMap::refined`] has k x k texels of it for each texel of the map,
//! each with the normal at its centre; a method is built from them as from any other map. Footprints are given in
//! uv, so that they are the same over both.
//!
//! **Error** Within a refined texel the normal is constant. Under a point a lobe is off by half the step between
//! neighbours along each axis at most. Where a footprint covers several of them these shifts cancel, and what is left is
//! the variance of normals inside a texel, a twelfth of the squared step, and the ripple of a sum of lobes that are a step
//! apart, `2 exp(-2 pi^2 / x^2)` with the step `x` in standard deviations `alpha / sqrt(2)` of the lobe. Measured as
//! relative L1 error of distributions of normals against the direct sum over 16 x 16 texels for each, over smooth and
//! bumpy waves, noise, brushing and scratches (`cargo run --release -p glints --example interpolation`):
//!
//! | root mean square step x | footprints of 4 texels' width | of 1 texel |
//! |---|---|---|
//! | 3 to 3.5 | 12 to 14 % | 22 to 30 % |
//! | 2.3 to 2.6 | 6 to 11 % | 15 to 25 % |
//! | 1.5 to 1.75 | 1.5 to 3 % | 3 to 8 % |
//! | 1 to 1.3 | 1 to 4 % | 2 to 7 % |
//! | 0.5 to 0.75 | below 1 % | below 1.5 % |
//!
//! Over these footprints the compact inverse bin map adds less than 1 % of its own. A refinement of 1 or another odd number is two to four times
//! worse: bilinear patches meet at the centres of texels, and only with an even one do borders of refined texels lie
//! there. That is 20 % and 27 % for 1 at x = 1.9, 4.5 % and 7.5 % at x = 0.9.
//!
//! Yan's curved elements, 4 x 4 for each texel, differ from the compact inverse bin map of a refined wave map by 0.6 % where both
//! have the same Gaussian footprint; without refinement it is 7 % (see the tests). With their own footprints, half a pixel's
//! standard deviation against a box, they differ by much more than that.
//!
//! **How many** [`automatic`] takes the least power of two with `x <=` [`LARGEST_STEP`], and 1 only below a third of that.
//!
//! **Memory** `k^2` times that of the method, for all texels alike, and 12 k^2 bytes a texel while it is built: 16, 63 and
//! 254 MB for k = 1, 2 and 4 of a map of 2048 x 2048 texels at alpha = 0.05, with a peak of 0.12, 0.31 and 1.09 GB. To
//! refine only where the map bends would save most of it on maps that are flat nearly everywhere, such as scratches, but
//! texels would have different areas: every query relies on equal ones, to weigh them by integers and to find them by
//! row and column. The other way to save it, a single texel with a lobe widened by the variance of the normals inside
//! (after LEAN mapping, Olano and Baker 2010), was measured with the map's mean variance. Over four texels it helps on noise
//! (26 % instead of 42 % at x = 6.6, 1.8 % instead of 3.7 % at x = 1) and is one and a half to four times worse on scratches,
//! brushing and smooth waves, as bends differ from texel to texel; it is not offered.

use glam::Vec3;
use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::microfacet::Flake;
use crate::normal_map::{MAX_SIDE, NormalMap};

/// Largest step between neighbouring refined texels, in standard deviations of a flake's lobe, that is taken for
/// resolved; see the module for what it costs.
pub const LARGEST_STEP: f64 = 1.5;

/// Most refined texels per texel and side.
pub const MAX_REFINEMENT: u32 = 8;

/// Most texels that a refinement makes unless it is asked for: 8192 x 8192, 0.8 GB while a method is built.
pub const MAX_AUTOMATIC_TEXELS: u64 = 1 << 26;

/// Most texels that can be asked for, 13 GB while a method is built.
pub const MAX_TEXELS: u64 = 1 << 30;

/// How finely an interpolated map is resampled, and what is left of its steps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Refinement {
    /// Refined texels per texel and side.
    pub refinement: u32,
    /// Root mean square step of normals between neighbouring refined texels, along the axis where it is larger, in
    /// standard deviations of a flake's lobe; zero for a mirror, which has none.
    pub step: f64,
    /// Whether the automatic refinement ended above [`LARGEST_STEP`].
    pub capped: bool,
}

impl Refinement {
    /// The refinement that is asked for, in 1 to [`MAX_REFINEMENT`], or the automatic one for zero.
    ///
    /// `flake` is `None` for mirrors, for which there is no automatic one.
    pub fn new(map: &NormalMap, flake: Option<Flake>, refinement: u32) -> Result<Self> {
        let chosen = match (refinement, flake) {
            (0, None) => {
                let reason = "mirrors, alpha = 0, have no lobe to derive it from; give 1 to 8";
                return Err(Error::parameter("refinement", refinement, reason));
            }
            (0, Some(flake)) => automatic(map, flake),
            (given, _) => given,
        };
        if chosen > MAX_REFINEMENT || !fits(map, chosen, MAX_TEXELS) {
            let reason = format!(
                "must be 1 to {MAX_REFINEMENT} texels for each texel and side, or 0 for as many as the map needs, and a \
                 map of {} x {} texels must stay below {MAX_SIDE} a side and 2^30 in all (13 GB)",
                map.width(),
                map.height()
            );
            return Err(Error::parameter("refinement", refinement, reason));
        }
        let step = flake.map_or(0.0, |flake| relative_step(map, flake) / f64::from(chosen));
        Ok(Self {
            refinement: chosen,
            step,
            capped: refinement == 0 && step > largest_step(chosen),
        })
    }

    /// What to tell if the automatic refinement had to stop before lobes cover the steps: the surface then looks
    /// faceted.
    pub fn warning(&self) -> Option<String> {
        let finer = match self.refinement {
            MAX_REFINEMENT => "",
            _ => ", a larger refinement than the automatic one (memory grows with its square)",
        };
        self.capped.then(|| {
            format!(
                "refinement = {} is as far as {MAX_REFINEMENT} texels for each and 8192 x 8192 in all go, but normals \
                 of neighbouring refined texels are still {:.1} standard deviations of a flake's lobe apart (root mean \
                 square; {LARGEST_STEP} are wanted), and the surface looks faceted; take a larger alpha, a map that \
                 bends less from texel to texel{finer}, or set the refinement to say that this is fine",
                self.refinement, self.step
            )
        })
    }
}

/// The least power of two that leaves steps of at most [`LARGEST_STEP`], and 1 if a third of that is left, as far as
/// [`MAX_REFINEMENT`] and [`MAX_AUTOMATIC_TEXELS`] allow.
pub fn automatic(map: &NormalMap, flake: Flake) -> u32 {
    let step = relative_step(map, flake);
    let resolves = |refinement: u32| step <= largest_step(refinement) * f64::from(refinement);
    let mut refinement = 1;
    while !resolves(refinement)
        && 2 * refinement <= MAX_REFINEMENT
        && fits(map, 2 * refinement, MAX_AUTOMATIC_TEXELS)
    {
        refinement *= 2;
    }
    refinement
}

/// The largest step that a refinement resolves: patches of the interpolation meet inside the texels of 1.
fn largest_step(refinement: u32) -> f64 {
    if refinement == 1 {
        LARGEST_STEP / 3.0
    } else {
        LARGEST_STEP
    }
}

fn fits(map: &NormalMap, refinement: u32, texels: u64) -> bool {
    let [width, height] = [map.width(), map.height()].map(|side| u64::from(side) * u64::from(refinement));
    width.max(height) <= MAX_SIDE.into() && width * height <= texels
}

/// The larger of [`steps`] in standard deviations of the lobe.
fn relative_step(map: &NormalMap, flake: Flake) -> f64 {
    let [u, v] = steps(map);
    u.max(v) * std::f64::consts::SQRT_2 / f64::from(flake.alpha())
}

/// Root mean square of the interpolated normal's derivative along u and v, per texel: what a step between neighbouring
/// refined texels is times their number.
///
/// Between the centres of four texels the derivative along u runs linearly from `p`, the difference of the lower two, to
/// `q`, that of the upper two; the mean of its square is `(p^2 + p q + q^2) / 3`. Differences are those of the
/// unit normals, not projected, so that steps at steep texels count as lobes there see them.
pub fn steps(map: &NormalMap) -> [f64; 2] {
    let (width, height) = (map.width(), map.height());
    let mean_square = |p: Vec3, q: Vec3| f64::from(p.length_squared() + p.dot(q) + q.length_squared()) / 3.0;
    let row_sums = |row: u32| {
        let above = (row + 1) % height;
        let mut sums = [0.0; 2];
        for column in 0..width {
            let right = (column + 1) % width;
            let [a, b] = [column, right].map(|column| map.normal(column, row));
            let [c, d] = [column, right].map(|column| map.normal(column, above));
            sums[0] += mean_square(b - a, d - c);
            sums[1] += mean_square(c - a, d - b);
        }
        sums
    };
    // Summed in the order of rows, so that the answer does not depend on the number of threads.
    let rows: Vec<[f64; 2]> = (0..height).into_par_iter().map(row_sums).collect();
    let texels = f64::from(width) * f64::from(height);
    [0, 1].map(|axis| (rows.iter().map(|row| row[axis]).sum::<f64>() / texels).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flakes::{FlakeModel, Normalization};
    use crate::footprint::Footprint;
    use crate::methods::Method;
    use crate::methods::compact::CompactBinMap;
    use crate::methods::direct::Direct;
    use crate::methods::yan16::{self, Elements, Yan16};
    use crate::microfacet::Distribution;
    use approx::assert_relative_eq;
    use glam::{DVec2, Vec2};
    use proptest::prelude::*;

    /// A periodic map whose normal turns by about `bend` from texel to texel.
    fn waves(bend: f32) -> NormalMap {
        let (width, height) = (24, 20);
        let normal = |i: u32| {
            let turn = |i: u32, side: u32| std::f32::consts::TAU * i as f32 / side as f32;
            let (u, v) = (turn(i % width, width), turn(i / width, height));
            let slopes = Vec2::new((u + 0.7 * v.sin()).sin(), (2.0 * v + 0.5 * u.cos()).cos());
            (bend * 3.0 * slopes).extend(1.0)
        };
        let normals: Vec<Vec3> = (0..width * height).map(normal).collect();
        NormalMap::from_normals("waves", width, height, &normals).unwrap()
    }

    fn flake(alpha: f32) -> Flake {
        Flake::new(Distribution::default(), alpha).unwrap()
    }

    fn model(alpha: f32) -> FlakeModel {
        FlakeModel {
            flake: flake(alpha),
            normalization: Normalization::Projected,
        }
    }

    /// The same part of the surface over a map of any resolution, in texels of `map`.
    fn footprint(map: &NormalMap, method: &dyn Method, center: DVec2, width: f64) -> Footprint {
        let (columns, rows) = method.map_size();
        let refinement = f64::from(columns) / f64::from(map.width());
        let a = DVec2::new(width * refinement, 0.0);
        Footprint::in_texels(columns, rows, center * refinement, a, a.perp())
    }

    /// Half vectors near the normals of an interpolated map about `center`.
    fn half_vectors(map: &NormalMap, center: DVec2, width: f64, deviation: f32) -> Vec<Vec3> {
        let mut state = 1_u32;
        let mut uniform = || {
            state = state.wrapping_mul(0x9e37_79b1).wrapping_add(0x85eb_ca77);
            f64::from((state ^ state >> 15).wrapping_mul(0x2c1b_3c6d) >> 8) / f64::from(1 << 24) - 0.5
        };
        (0..60)
            .map(|_| {
                let normal = map.interpolated(center + width * DVec2::new(uniform(), uniform()));
                let s = normal + 3.0 * deviation * DVec2::new(uniform(), uniform()).as_vec2();
                s.extend((1.0 - s.length_squared()).sqrt())
            })
            .collect()
    }

    /// Sum of `|a - b|` over that of `b`.
    fn distance(pairs: impl Iterator<Item = (f32, f32)>) -> f32 {
        let (difference, total) = pairs.fold((0.0, 0.0), |(d, t), (a, b)| (d + (a - b).abs(), t + b));
        difference / total
    }

    proptest! {
        #[test]
        fn refined_normals_are_interpolated_at_their_centres(
            (width, height, vectors) in (1..6_u32, 1..6_u32).prop_flat_map(|(width, height)| {
                let vector = (-20.0..20.0_f32, -20.0..20.0_f32, 0.05..1.0_f32);
                let count = (width * height) as usize;
                (Just(width), Just(height), proptest::collection::vec(vector, count))
            }),
            refinement in 1..=8_u32,
        ) {
            let vectors: Vec<Vec3> = vectors.into_iter().map(Vec3::from).collect();
            let map = NormalMap::from_normals("random", width, height, &vectors).unwrap();
            let refined = map.refined(refinement).unwrap();
            prop_assert_eq!((refined.width(), refined.height()), (width * refinement, height * refinement));
            prop_assert_eq!(refined.name(), map.name());
            for row in 0..refined.height() {
                for column in 0..refined.width() {
                    let position = (DVec2::new(column.into(), row.into()) + 0.5) / f64::from(refinement);
                    let normal = refined.normal(column, row);
                    prop_assert!(normal.z > 0.0 && (normal.length() - 1.0).abs() < 1e-5);
                    let expected = map.interpolated(position);
                    prop_assert!((normal.truncate() - expected).length() < 1e-5, "{column} {row}");
                }
            }
        }
    }

    #[test]
    fn a_refinement_of_one_is_the_map() {
        let map = waves(0.1);
        assert_eq!(map.refined(1).unwrap().normals(), map.normals());
    }

    #[test]
    fn a_ramp_stays_a_ramp_and_the_last_texel_leads_to_the_first() {
        let at = |u: f32| Vec2::new(0.02 * u - 0.1, 0.05 - 0.01 * u);
        let lift = |s: Vec2| s.extend((1.0 - s.length_squared()).sqrt());
        let normals: Vec<Vec3> = (0..10).map(|u| lift(at(u as f32))).collect();
        let refined = NormalMap::from_normals("ramp", 10, 1, &normals)
            .unwrap()
            .refined(4)
            .unwrap();
        for column in 0..40 {
            // In texels from the first one's centre.
            let u = (column as f32 + 0.5) / 4.0 - 0.5;
            let ends = [at(9.0), at(0.0)];
            let expected = match u {
                u if u < 0.0 => ends[1].lerp(ends[0], -u),
                u if u > 9.0 => ends[0].lerp(ends[1], u - 9.0),
                u => at(u),
            };
            for row in 0..4 {
                assert!(
                    (refined.normal(column, row) - lift(expected)).length() < 1e-6,
                    "{column}"
                );
            }
        }
    }

    #[test]
    fn steps_are_those_between_neighbours() {
        let map = waves(0.15);
        let expected = steps(&map);
        let refined = map.refined(8).unwrap();
        let (width, height) = (refined.width(), refined.height());
        let mut sums = [0.0; 2];
        for (column, row) in (0..height).flat_map(|row| (0..width).map(move |column| (column, row))) {
            let normal = refined.normal(column, row);
            let neighbours = [((column + 1) % width, row), (column, (row + 1) % height)];
            for (sum, (column, row)) in sums.iter_mut().zip(neighbours) {
                *sum += f64::from((refined.normal(column, row) - normal).length_squared());
            }
        }
        for (sum, expected) in sums.into_iter().zip(expected) {
            let found = (sum / f64::from(width * height)).sqrt();
            assert_relative_eq!(found, expected / 8.0, max_relative = 0.02);
        }
    }

    #[test]
    fn bends_and_roughness_decide_how_many() {
        let map = waves(0.1);
        let one = relative_step(&map, flake(0.1));
        // Flakes that see a step of the given size at a refinement of one.
        let chosen = |step: f64| Refinement::new(&map, Some(flake((0.1 * one / step) as f32)), 0).unwrap();
        for (step, refinement) in [(0.4, 1), (0.6, 2), (2.9, 2), (3.1, 4), (5.9, 4), (11.0, 8)] {
            let found = chosen(step);
            assert_eq!(found.refinement, refinement, "{step}");
            assert_relative_eq!(found.step, step / f64::from(refinement), max_relative = 1e-3);
            assert!(!found.capped && found.warning().is_none());
        }
        let capped = chosen(20.0);
        assert!(capped.capped && capped.refinement == MAX_REFINEMENT);
        let warning = capped.warning().unwrap();
        assert!(warning.contains("2.5 standard deviations"), "{warning}");
        // Who asks for a number gets it without a word.
        let given = Refinement::new(&map, Some(flake(0.01)), 3).unwrap();
        assert!(given.refinement == 3 && given.warning().is_none());
        let flat = NormalMap::from_normals("flat", 2, 2, &[Vec3::Z; 4]).unwrap();
        assert_eq!(automatic(&flat, flake(0.0001)), 1);
    }

    #[test]
    fn the_number_of_texels_is_bounded() {
        let flat = |width: u32, height: u32| {
            NormalMap::from_normals("flat", width, height, &vec![Vec3::Z; (width * height) as usize]).unwrap()
        };
        let message = |map: &NormalMap, flake, refinement| {
            Refinement::new(map, flake, refinement).unwrap_err().to_string()
        };
        let lobe = Some(flake(0.01));
        for (map, refinement) in [
            (flat(4, 4), 9),
            (flat(4, 4), u32::MAX),
            (flat(9000, 1), 8),
            (flat(5000, 1000), 16),
        ] {
            let message = message(&map, lobe, refinement);
            assert!(
                message.contains("\"refinement\"") && message.contains("1 to 8"),
                "{message}"
            );
        }
        assert!(message(&flat(4, 4), None, 0).contains("mirrors"));
        assert_eq!(Refinement::new(&flat(4, 4), None, 2).unwrap().refinement, 2);
        assert!(
            flat(9000, 1)
                .refined(8)
                .unwrap_err()
                .to_string()
                .contains("65535")
        );
        assert!(flat(4, 4).refined(0).is_err());
        // Beyond 8192 x 8192 texels the automatic one stops, whatever is left.
        assert!(fits(&flat(2048, 8), 8, MAX_AUTOMATIC_TEXELS));
        assert!(!fits(&flat(4096, 1025), 4, MAX_AUTOMATIC_TEXELS));
    }

    /// `D` of the interpolated surface over a box, by the midpoint rule over 40 x 40 points a texel.
    fn exact(map: &NormalMap, model: &FlakeModel, center: DVec2, width: u32, halves: &[Vec3]) -> Vec<f32> {
        let side = 40 * width;
        let mut sums = vec![0.0_f64; halves.len()];
        for i in 0..side * side {
            let p = (DVec2::new((i % side).into(), (i / side).into()) + 0.5) / f64::from(side) - 0.5;
            let normal = map.interpolated_normal(center + f64::from(width) * p);
            for (sum, &h) in sums.iter_mut().zip(halves) {
                *sum += f64::from(model.ndf(h, normal, 1.0));
            }
        }
        sums.iter()
            .map(|sum| (sum / f64::from(side * side)) as f32)
            .collect()
    }

    #[test]
    fn methods_over_a_refined_map_show_the_interpolated_surface() {
        let map = waves(0.1);
        for alpha in [0.03, 0.1] {
            let model = model(alpha);
            let refinement = Refinement::new(&map, Some(model.flake), 0).unwrap().refinement;
            let refined = map.refined(refinement).unwrap();
            let methods: [Box<dyn Method>; 3] = [
                Box::new(Direct::new(refined.clone(), model)),
                Box::new(CompactBinMap::new(&refined, model)),
                // The twin: flat texels.
                Box::new(Direct::new(map.clone(), model)),
            ];
            for (width, stated) in [(1, 0.08), (4, 0.04)] {
                let mut errors = [0.0; 3];
                for center in [
                    DVec2::new(7.3, 12.9),
                    DVec2::new(23.6, 0.2),
                    DVec2::new(15.2, 5.4),
                ] {
                    let halves = half_vectors(&map, center, width.into(), alpha);
                    let expected = exact(&map, &model, center, width, &halves);
                    for (error, method) in errors.iter_mut().zip(&methods) {
                        let footprint = footprint(&map, method.as_ref(), center, width.into());
                        let found = halves.iter().map(|&h| method.ndf(&footprint, h));
                        *error += distance(found.zip(expected.iter().copied())) / 3.0;
                    }
                }
                let [direct, compact, flat] = errors;
                assert!(direct < stated && compact < stated, "{alpha} {width}: {errors:?}");
                assert!(flat > 1.5 * stated, "{alpha} {width}: {errors:?}");
            }
        }
    }

    #[test]
    fn refined_maps_and_curved_elements_are_the_same_surface() {
        // Yan's Gaussian footprint as a mixture of boxes that are narrow against it.
        let map = waves(0.05);
        let (alpha, width) = (0.05_f32, 3.0);
        let options = yan16::Options {
            elements: Elements::Curved { refinement: 4 },
            intrinsic: alpha / std::f32::consts::SQRT_2,
            ..yan16::Options::default()
        };
        let yan = Yan16::new(&map, options).unwrap();
        let deviation = f64::from(options.footprint_sigma) * width;
        let refined = map.refined(automatic(&map, flake(alpha))).unwrap();
        let interpolated = CompactBinMap::new(&refined, model(alpha));
        let flat = CompactBinMap::new(&map, model(alpha));
        let under_gaussian = |method: &dyn Method, center: DVec2, h: Vec3| {
            const BOXES: i32 = 28;
            let side = 8.0 * deviation / f64::from(BOXES);
            let (mut sum, mut total) = (0.0, 0.0);
            for i in 0..BOXES * BOXES {
                let offset =
                    (DVec2::new((i % BOXES).into(), (i / BOXES).into()) + 0.5) * side - 4.0 * deviation;
                let weight = (-0.5 * offset.length_squared() / deviation.powi(2)).exp();
                let footprint = footprint(&map, method, center + offset, side);
                sum += weight * f64::from(method.ndf(&footprint, h));
                total += weight;
            }
            (sum / total) as f32
        };
        let center = DVec2::new(9.4, 3.8);
        let yans = footprint(&map, &yan, center, width);
        let halves = half_vectors(&map, center, 1.5 * width, alpha);
        let error = |method: &dyn Method| {
            distance(
                halves
                    .iter()
                    .map(|&h| (under_gaussian(method, center, h), yan.ndf(&yans, h))),
            )
        };
        let (interpolated, flat) = (error(&interpolated), error(&flat));
        assert!(interpolated < 0.015, "{interpolated}");
        assert!(flat > 0.04, "{flat} {interpolated}");
    }
}
