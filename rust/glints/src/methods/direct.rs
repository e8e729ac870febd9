//! The direct sum: every texel of the footprint, exactly.
//!
//! **Computes** Eq. 11 and 12 of Atanasov et al. 2021, `sum_k w_k C(i, o, t_k)` with `w_k = |A n T_k| / |A|`,
//! or with the weights of another filter ([`crate::footprint_filter`]), without bins and without truncating lobes.
//! It is the ground truth of every filtered estimator over the same footprint.
//!
//! **Layout** One unit normal a texel, 12 bytes.
//!
//! **Cost** Proportional to the texels of the footprint, at most about fifty periods of the map. A Gaussian of
//! half a pixel reaches 14 times as many as the box, and at most about two hundred periods. Weights are computed
//! where a lobe reaches the half vector only. `sample` costs O(1).

use glam::{Vec2, Vec3};

use super::{Method, Reflection, mean_over};
use crate::flakes::FlakeModel;
use crate::footprint::Footprint;
use crate::footprint_filter::{FilteredPart, FootprintFilter, Window};
use crate::half_vector::DirectionPair;
use crate::normal_map::NormalMap;

pub struct Direct {
    map: NormalMap,
    model: FlakeModel,
    filter: FootprintFilter,
}

/// Weights of consecutive texels of a row, computed when they are asked for.
enum Weights<'a> {
    Even(f32),
    Of {
        window: &'a Window,
        column: u32,
        row: u32,
    },
}

impl Weights<'_> {
    #[inline]
    fn at(&self, index: usize) -> f32 {
        match self {
            Self::Even(weight) => *weight,
            Self::Of { window, column, row } => window.texel_weight(column + index as u32, *row) as f32,
        }
    }
}

impl Direct {
    /// Over the pixel's box.
    pub fn new(map: NormalMap, model: FlakeModel) -> Self {
        Self::with_filter(map, model, FootprintFilter::Box)
    }

    pub fn with_filter(map: NormalMap, model: FlakeModel, filter: FootprintFilter) -> Self {
        Self { map, model, filter }
    }

    /// Calls `visit` with the normal and the weight `w_k` of every texel of the footprint; weights sum to one.
    pub fn for_each_texel(&self, footprint: &Footprint, mut visit: impl FnMut(Vec3, f32)) {
        self.for_each_run(footprint, |normals, weights| {
            for (i, &t) in normals.iter().enumerate() {
                visit(t, weights.at(i));
            }
        });
    }

    /// The same, run by run.
    #[inline]
    fn for_each_run(&self, footprint: &Footprint, mut visit: impl FnMut(&[Vec3], Weights)) {
        let filtered = self.filter.over(footprint);
        filtered.for_each_part(|part| match part {
            FilteredPart::Texel { column, row } => visit(&[self.map.normal(column, row)], Weights::Even(1.0)),
            FilteredPart::Cut(window) => self.for_each_run_of(&window, &mut visit),
            FilteredPart::Whole(weight) => visit(self.map.normals(), Weights::Even(weight as f32)),
        });
    }

    #[inline]
    fn for_each_run_of(&self, window: &Window, visit: &mut impl FnMut(&[Vec3], Weights)) {
        let width = self.map.width() as usize;
        for span in window.texel_spans(self.map.width(), self.map.height()) {
            let row = &self.map.normals()[span.row as usize * width..][..width];
            let run = |(start, end): (i64, i64)| &row[start as usize..end as usize];
            if let Some(weight) = window.even_weight() {
                visit(run(span.inside), Weights::Even(weight as f32));
            }
            for cut in [(span.touched.0, span.inside.0), (span.inside.1, span.touched.1)] {
                let (column, row) = (cut.0 as u32, span.row as u32);
                visit(run(cut), Weights::Of { window, column, row });
            }
        }
    }

    /// Calls `visit` with the texels of the footprint whose lobe reaches `h`.
    #[inline]
    fn for_each_lobe(&self, footprint: &Footprint, h: Vec3, mut visit: impl FnMut(Vec3, f32)) {
        const BLOCK: usize = 16;
        self.for_each_run(footprint, |normals, weights| {
            for (i, block) in normals.chunks(BLOCK).enumerate() {
                if !self.model.flake.misses_all(h, block) {
                    for (j, &t) in block.iter().enumerate() {
                        visit(t, weights.at(BLOCK * i + j));
                    }
                }
            }
        });
    }

    fn sum(&self, footprint: &Footprint, h: Vec3, term: impl Fn(Vec3, f32) -> f32) -> f32 {
        let mut sum = 0.0;
        self.for_each_lobe(footprint, h, |t, weight| sum += f64::from(term(t, weight)));
        sum as f32
    }
}

impl Method for Direct {
    fn evaluate(&self, footprint: &Footprint, pair: &DirectionPair) -> Reflection {
        let (mut value, mut density) = (0.0, 0.0);
        self.for_each_lobe(footprint, pair.half, |t, weight| {
            let term = self.model.reflection(pair, t, weight);
            value += f64::from(term.value);
            density += f64::from(term.density);
        });
        Reflection {
            value: value as f32,
            density: density as f32,
        }
    }

    fn density(&self, footprint: &Footprint, h: Vec3) -> f32 {
        self.sum(footprint, h, |t, weight| self.model.density(h, t, weight))
    }

    fn ndf(&self, footprint: &Footprint, h: Vec3) -> f32 {
        self.sum(footprint, h, |t, weight| self.model.ndf(h, t, weight))
    }

    fn ndf_over(&self, footprint: &Footprint, low: Vec2, high: Vec2) -> Option<f32> {
        Some(mean_over(low, high, || {
            let mut sum = 0.0;
            self.for_each_texel(footprint, |t, weight| {
                sum += self.model.ndf_integral(t, weight, low, high)
            });
            sum
        }))
    }

    fn sample(&self, footprint: &Footprint, u: [f32; 4]) -> Option<Vec3> {
        let (column, row) = self
            .filter
            .over(footprint)
            .sample_texel([u[0].into(), u[1].into()]);
        self.model.sample(self.map.normal(column, row), [u[2], u[3]])
    }

    fn map_size(&self) -> (u32, u32) {
        (self.map.width(), self.map.height())
    }

    fn structure_bytes(&self) -> usize {
        size_of_val(self.map.normals())
    }

    fn name(&self) -> &'static str {
        "direct"
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flakes::Normalization;
    use crate::methods::unfiltered::{Interpolation, Unfiltered};
    use crate::microfacet::{Distribution, Flake};
    use approx::assert_relative_eq;
    use glam::DVec2;

    fn tilted_map() -> NormalMap {
        let normal = |i: u32| {
            let angle = i as f32;
            Vec3::new(0.3 * (angle * 2.4).sin(), 0.3 * (angle * 1.7).cos(), 1.0).normalize()
        };
        let normals: Vec<Vec3> = (0..24 * 16).map(normal).collect();
        NormalMap::from_normals("tilted", 24, 16, &normals).unwrap()
    }

    /// The mean of `ndf` over the midpoints of 250 x 250 cells; points outside the disk count as zero.
    fn averaged(method: &dyn Method, footprint: &Footprint, low: Vec2, high: Vec2) -> f64 {
        const SIDE: usize = 250;
        let value = |i: usize| {
            let cell = Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5) / SIDE as f32;
            let p = low + cell * (high - low);
            let z2 = 1.0 - p.length_squared();
            if z2 > 0.0 {
                f64::from(method.ndf(footprint, p.extend(z2.sqrt())))
            } else {
                0.0
            }
        };
        (0..SIDE * SIDE).map(value).sum::<f64>() / (SIDE * SIDE) as f64
    }

    #[test]
    fn ranges_are_averages_of_points() {
        for (kind, normalization) in [
            (Distribution::Beckmann, Normalization::Projected),
            (Distribution::Beckmann, Normalization::Paper),
            (Distribution::Ggx, Normalization::Projected),
        ] {
            let model = FlakeModel {
                flake: Flake::new(kind, 0.08).unwrap(),
                normalization,
            };
            let direct = Direct::new(tilted_map(), model);
            let unfiltered = Unfiltered::new(tilted_map(), model, Interpolation::Nearest);
            let footprint = |width: f64| {
                let (a, b) = (DVec2::new(width, 0.4), DVec2::new(-0.3, width));
                Footprint::in_texels(24, 16, DVec2::new(7.2, 5.1), a, b)
            };
            for (method, width) in [(&direct as &dyn Method, 5.0), (&direct, 16.0), (&unfiltered, 0.0)] {
                for (low, high) in [
                    (Vec2::new(-0.1, -0.05), Vec2::new(0.25, 0.3)),
                    (Vec2::new(-0.35, 0.1), Vec2::new(-0.3, 0.9)),
                    (Vec2::new(-1.0, -1.0), Vec2::new(1.0, 1.0)),
                    (Vec2::new(-0.02, -0.2), Vec2::new(1.3, 0.4)),
                ] {
                    let mean = method.ndf_over(&footprint(width), low, high).unwrap();
                    let expected = averaged(method, &footprint(width), low, high);
                    assert_relative_eq!(f64::from(mean), expected, max_relative = 2e-3, epsilon = 1e-4);
                }
            }
            // Twin: the density at the centre instead of the mean.
            let (low, high) = (Vec2::new(-0.35, 0.1), Vec2::new(-0.3, 0.9));
            let center = 0.5 * (low + high);
            let h = center.extend((1.0 - center.length_squared()).sqrt());
            let expected = averaged(&direct, &footprint(5.0), low, high);
            assert!((f64::from(direct.ndf(&footprint(5.0), h)) / expected - 1.0).abs() > 0.1);
            assert_eq!(direct.ndf_over(&footprint(5.0), high, low), Some(0.0));
        }
    }
}
