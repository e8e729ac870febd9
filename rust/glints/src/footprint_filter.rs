//! The filter that a footprint is seen through, and the weights of texels under it.
//!
//! **Computes** `w_k`, the integral over texel k of a density over the footprint. Atanasov et al. 2021 weight
//! all of the pixel evenly, `w_k = |A n T_k| / |A|` (Eq. 12, [`FootprintFilter::Box`]), and name smoother
//! filters as future work (Section 7). [`FootprintFilter::Gaussian`] is that of Yan et al. 2014 and 2016 (after
//! Heckbert 1989), whose covariance is `deviation^2 (a a^T + b b^T)` for a parallelogram with the edges a and b
//! ([`crate::gaussian_footprint`]). In the parallelogram's coordinates it is a product,
//!
//! ```text
//! G(p) = N(s(p) / deviation) N(t(p) / deviation) / (deviation^2 |a x b|),    N(z) = exp(-z^2 / 2) / sqrt(2 pi),
//! ```
//!
//! cut where `|s|` or `|t|` exceed [`RADIUS`] deviations and divided by what is left, 0.99963. What it reaches is
//! therefore a parallelogram again, the box's with edges `2 RADIUS deviation` times as long, and tiles, rows and
//! texels outside are found as for the box.
//!
//! **Weights of the Gaussian** In whitened coordinates `z = (s, t) / deviation` a rectangle of texels is a
//! parallelogram with a centre `z_0` and edges U, V.
//!
//! * Where that is cut, or an edge is longer than [`LONGEST_SMALL`]: it is clipped to the square `|z| <= RADIUS`,
//!   and Green's theorem leaves integrals along its sides, `|sum of integral of N(z_x) erf(z_y / sqrt 2) / 2
//!   dz_x|`, of a function without scales below one, however thin the footprint. Gauss-Legendre's rule of six
//!   nodes over steps of at most one is within 1e-10 there.
//! * Else by the Taylor series of G about `z_0`, up to the fourth order: one exponential a texel. The next terms
//!   are below 3e-6 in all, summed over the texels of a footprint.
//!
//! **Exactness** Weights are within 3e-6 in all, and sum to one within 2e-6 (within 1e-5 under a footprint thinner than a thousandth of a
//! texel, whose coordinates double precision resolves no better). [`FilteredFootprint::sample_texel`] draws a point
//! of the very same density, by the inverse of its distribution function along s and t, so that a texel is drawn
//! with its weight as probability.
//!
//! **Tiling** The map repeats. A Gaussian whose sum over all repetitions is constant to 0.1 %
//! ([`Reach::Whole`]) weights all texels evenly. Deviations of more than `MAX_TILES / sqrt(12)` periods, the
//! deviation of the longest box, are shortened to that.
//!
//! **Adding a filter to a method** [`FilteredFootprint::for_each_part`] hands out one [`Window`] a tile. It tells
//! of any rectangle of texels whether it is outside, or has even weights ([`Window::coverage`]), what it weighs
//! ([`Window::weight`]), and between which bounds the weights in it lie ([`Window::density_bounds`]).

use std::f64::consts::{FRAC_1_SQRT_2, PI, TAU};

use glam::DVec2;

use crate::error::Result;
use crate::footprint::{Coverage, Footprint, MAX_TILES, Parallelogram, Part, Polygon, Span};
use crate::gaussian_footprint::{GaussianFootprint, Reach, checked_deviation};

/// Deviations at which the Gaussian is cut along each axis of the pixel: the radius at which `glints_yan16` cuts
/// its Gaussians, `sqrt(14)`.
pub const RADIUS: f64 = 3.741_657_386_773_941_4;

/// Mass of `N(z_x) N(z_y)` in the square `|z| <= RADIUS`, `erf(RADIUS / sqrt 2)^2`.
pub(crate) const KEPT: f64 = 0.999_634_412_153_763_8;

/// Longest edge, in deviations, of a rectangle that the Taylor series answers for.
pub(crate) const LONGEST_SMALL: f64 = 0.35;

/// Longest step of the Gauss-Legendre rule along the sides of a clipped rectangle, in deviations.
const STEP: f64 = 1.0;

/// Positive nodes of the Gauss-Legendre rule of six points on [-1, 1], and their weights.
const NODES: [(f64, f64); 3] = [
    (0.238_619_186_083_196_9, 0.467_913_934_572_691_05),
    (0.661_209_386_466_264_5, 0.360_761_573_048_138_6),
    (0.932_469_514_203_152, 0.171_324_492_379_170_35),
];

/// How a pixel weights what it sees.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum FootprintFilter {
    /// Evenly over the parallelogram of the ray differentials.
    #[default]
    Box,
    /// By a Gaussian with this standard deviation along each edge of the parallelogram, in units of the edge:
    /// 1/2 in Yan et al.'s published implementation; `1 / sqrt(12) = 0.29` has the variance of the box.
    Gaussian { deviation: f64 },
}

/// A footprint under a filter.
#[derive(Clone, Copy, Debug)]
pub struct FilteredFootprint {
    footprint: Footprint,
    support: Support,
}

#[derive(Clone, Copy, Debug)]
enum Support {
    /// The box, and a point under any filter.
    Box,
    /// The parallelogram at which the Gaussian is cut.
    Gaussian(Parallelogram),
    /// All texels of the map evenly.
    Even,
}

/// One part of a filtered footprint, in the coordinates of the map: `[0, width) x [0, height)`.
#[derive(Clone, Copy, Debug)]
pub enum FilteredPart {
    /// The texel under a footprint without extent; its weight is one.
    Texel { column: u32, row: u32 },
    /// The weights of this window's texels.
    Cut(Window),
    /// Every texel of the map, with this weight each.
    Whole(f64),
}

/// Weights over one tile of the map, those of other tiles left out.
#[derive(Clone, Copy, Debug)]
pub struct Window {
    /// Outside of it weights are zero.
    region: Parallelogram,
    shape: Shape,
}

#[derive(Clone, Copy, Debug)]
enum Shape {
    /// Even; the value is that of a whole texel.
    Box(f64),
    Gaussian,
}

impl FootprintFilter {
    /// The Gaussian; `deviation` in units of the footprint's edges, in [0.05, 4].
    ///
    /// # Errors
    /// A deviation outside of its domain, as parameter `footprint_sigma`.
    pub fn gaussian(deviation: f32) -> Result<Self> {
        Ok(Self::Gaussian {
            deviation: checked_deviation(deviation)?,
        })
    }

    /// The footprint under this filter.
    pub fn over(self, footprint: &Footprint) -> FilteredFootprint {
        let support = match (self, footprint.region()) {
            (Self::Gaussian { deviation }, Some(region)) => gaussian_support(footprint, region, deviation),
            _ => Support::Box,
        };
        FilteredFootprint {
            footprint: *footprint,
            support,
        }
    }
}

fn gaussian_support(footprint: &Footprint, region: &Parallelogram, deviation: f64) -> Support {
    if GaussianFootprint::new(footprint, deviation).reach(0.0) == Reach::Whole {
        return Support::Even;
    }
    let longest = MAX_TILES / 12_f64.sqrt();
    let factor = |edge: DVec2| {
        let periods = deviation * (edge / footprint.map_size()).length();
        2.0 * RADIUS * deviation * (longest / periods.max(longest))
    };
    Support::Gaussian(region.scaled(region.edges().map(factor)))
}

impl FilteredFootprint {
    /// Calls `visit` with every part of the footprint. Weights sum to one.
    #[inline]
    pub fn for_each_part(&self, mut visit: impl FnMut(FilteredPart)) {
        let size = self.footprint.map_size();
        let window = |region, shape| FilteredPart::Cut(Window { region, shape });
        match &self.support {
            Support::Box => {
                let inv_area = 1.0 / self.footprint.area();
                self.footprint.for_each_part(|part| {
                    visit(match part {
                        Part::Texel { column, row } => FilteredPart::Texel { column, row },
                        Part::Cut(region) => window(region, Shape::Box(inv_area)),
                        Part::Whole(count) => FilteredPart::Whole(count as f64 * inv_area),
                    });
                });
            }
            Support::Gaussian(region) => region.for_each_tile(size, |r| visit(window(r, Shape::Gaussian))),
            Support::Even => visit(FilteredPart::Whole(1.0 / (size.x * size.y))),
        }
    }

    /// A texel, drawn with its weight as probability by two independent uniform numbers on [0, 1).
    #[inline]
    pub fn sample_texel(&self, u: [f64; 2]) -> (u32, u32) {
        self.sample_part(u).0
    }

    /// The same, and the window over the tile that the texel was drawn in; `None` for a point, and for what weights
    /// all texels of the map evenly.
    #[inline]
    pub fn sample_part(&self, u: [f64; 2]) -> ((u32, u32), Option<Window>) {
        let size = self.footprint.map_size();
        match &self.support {
            Support::Box => {
                let (texel, region) = self.footprint.sample_part(u);
                (texel, region.map(|region| self.window(region)))
            }
            Support::Gaussian(region) => {
                let st = DVec2::from(u.map(|u| truncated_normal(u) / (2.0 * RADIUS)));
                let point = region.point(st);
                let tile = (point / size).floor() * size;
                let texel = self.footprint.texel_at(point);
                (texel, Some(self.window(region.moved(-tile))))
            }
            Support::Even => (self.footprint.texel_at(DVec2::from(u) * size), None),
        }
    }

    /// What the filter reaches, in unwrapped texel coordinates; `None` for a point, and for what weights all texels of
    /// the map evenly.
    #[inline]
    pub fn region(&self) -> Option<&Parallelogram> {
        match &self.support {
            Support::Box => self.footprint.region(),
            Support::Gaussian(region) => Some(region),
            Support::Even => None,
        }
    }

    /// [`Window::texel_in_deviations`], the same in all windows; `None` for a point, too.
    #[inline]
    pub fn texel_in_deviations(&self) -> Option<[DVec2; 2]> {
        self.region()
            .and_then(|region| self.window(*region).texel_in_deviations())
    }

    /// The only window, if the filter reaches no further than one period of the map.
    #[inline]
    pub fn single_window(&self) -> Option<Window> {
        let region = match &self.support {
            Support::Box => self.footprint.single_part()?,
            Support::Gaussian(region) if region.is_within(DVec2::ZERO, self.footprint.map_size()) => region,
            _ => return None,
        };
        Some(self.window(*region))
    }

    fn window(&self, region: Parallelogram) -> Window {
        let shape = match self.support {
            Support::Box => Shape::Box(1.0 / self.footprint.area()),
            _ => Shape::Gaussian,
        };
        Window { region, shape }
    }
}

impl Window {
    /// Outside of it weights are zero.
    #[inline]
    pub fn region(&self) -> &Parallelogram {
        &self.region
    }

    /// By how many of its deviations a Gaussian's argument z changes along each axis of the pixel, over the width and
    /// over the height of a texel; `None` for the box.
    #[inline]
    pub fn texel_in_deviations(&self) -> Option<[DVec2; 2]> {
        match self.shape {
            Shape::Box(_) => None,
            Shape::Gaussian => Some(self.whitened_edges(DVec2::ONE)),
        }
    }

    /// How the box `[low, high]` lies: `Outside` weighs nothing, and `Inside` every texel weighs the same,
    /// [`Window::even_weight`]. Nothing is `Inside` under a Gaussian.
    #[inline]
    pub fn coverage(&self, low: DVec2, high: DVec2) -> Coverage {
        match (self.region.coverage(low, high), self.shape) {
            (Coverage::Inside, Shape::Gaussian) => Coverage::Cut,
            (coverage, _) => coverage,
        }
    }

    /// The weight of every texel that lies inside; `None` under a Gaussian.
    #[inline]
    pub fn even_weight(&self) -> Option<f64> {
        match self.shape {
            Shape::Box(weight) => Some(weight),
            Shape::Gaussian => None,
        }
    }

    /// The weight of the box `[low, high]`, which need not be one of whole texels.
    #[inline]
    pub fn weight(&self, low: DVec2, high: DVec2) -> f64 {
        match self.shape {
            Shape::Box(weight) => self.region.overlap(low, high) * weight,
            Shape::Gaussian => self.gaussian_weight(low, high),
        }
    }

    /// The weight of the texel `(column, row)`.
    #[inline]
    pub fn texel_weight(&self, column: u32, row: u32) -> f64 {
        let low = DVec2::new(f64::from(column), f64::from(row));
        self.weight(low, low + 1.0)
    }

    /// Least and greatest weight per area at the points of the box `[low, high]`, or bounds of them.
    pub fn density_bounds(&self, low: DVec2, high: DVec2) -> (f64, f64) {
        let coverage = self.region.coverage(low, high);
        let (least, greatest) = match (coverage, self.shape) {
            (Coverage::Outside, _) => return (0.0, 0.0),
            (_, Shape::Box(weight)) => (weight, weight),
            (_, Shape::Gaussian) => self.gaussian_bounds(low, high),
        };
        match coverage {
            Coverage::Inside => (least, greatest),
            _ => (0.0, greatest),
        }
    }

    /// Rows of the map's texels that may weigh something; weights are even `inside`.
    #[inline]
    pub fn texel_spans(&self, width: u32, height: u32) -> impl Iterator<Item = Span> + use<> {
        let is_even = self.even_weight().is_some();
        self.region.texel_spans(width, height).map(move |span| Span {
            inside: if is_even {
                span.inside
            } else {
                (span.touched.0, span.touched.0)
            },
            ..span
        })
    }

    /// About how many texels weigh something.
    pub fn texel_count(&self) -> f64 {
        self.region.texel_count()
    }

    fn gaussian_weight(&self, low: DVec2, high: DVec2) -> f64 {
        match self.region.coverage(low, high) {
            Coverage::Outside => 0.0,
            Coverage::Inside => {
                let [u, v] = self.whitened_edges(high - low);
                if u.length_squared().max(v.length_squared()) <= LONGEST_SMALL * LONGEST_SMALL {
                    series(self.whitened(0.5 * (low + high)), u, v) / KEPT
                } else {
                    self.clipped_weight(low, high)
                }
            }
            Coverage::Cut => self.clipped_weight(low, high),
        }
    }

    fn clipped_weight(&self, low: DVec2, high: DVec2) -> f64 {
        let corners = [low, DVec2::new(high.x, low.y), high, DVec2::new(low.x, high.y)];
        let mut polygon = Polygon::new(&corners.map(|p| self.whitened(p)));
        polygon.clip(|z| RADIUS - z.x);
        polygon.clip(|z| RADIUS + z.x);
        polygon.clip(|z| RADIUS - z.y);
        polygon.clip(|z| RADIUS + z.y);
        let sum: f64 = polygon.sides().map(|(p, q)| below_side(p, q)).sum();
        sum.abs() / KEPT
    }

    /// z at a point.
    fn whitened(&self, point: DVec2) -> DVec2 {
        let [(_, s), (_, t)] = self.region.slabs_at(point);
        2.0 * RADIUS * DVec2::new(s, t)
    }

    /// By how much z changes over a width and over a height.
    fn whitened_edges(&self, extent: DVec2) -> [DVec2; 2] {
        let [(s, _), (t, _)] = self.region.slabs_at(self.region.center());
        [
            2.0 * RADIUS * extent.x * DVec2::new(s.x, t.x),
            2.0 * RADIUS * extent.y * DVec2::new(s.y, t.y),
        ]
    }

    fn gaussian_bounds(&self, low: DVec2, high: DVec2) -> (f64, f64) {
        let [u, v] = self.whitened_edges(high - low);
        let (center, reach) = (self.whitened(0.5 * (low + high)).abs(), 0.5 * (u.abs() + v.abs()));
        let peak = 4.0 * RADIUS * RADIUS / (TAU * KEPT * self.region.area());
        let density = |z: DVec2| peak * (-0.5 * z.length_squared()).exp();
        (
            density(center + reach),
            density((center - reach).max(DVec2::ZERO)),
        )
    }
}

/// Integral of `N(x) N(y)` over the parallelogram with centre `z` and the edges `u` and `v`, by Taylor's series up
/// to the fourth order. Derivatives along the edges are the Gaussian times Hermite polynomials in `a = z . u` and
/// `b = z . v`; those of odd order cancel.
fn series(z: DVec2, u: DVec2, v: DVec2) -> f64 {
    let (a2, b2, ab) = (z.dot(u).powi(2), z.dot(v).powi(2), z.dot(u) * z.dot(v));
    let (uu, vv, uv) = (u.length_squared(), v.length_squared(), u.dot(v));
    let second = (a2 - uu) + (b2 - vv);
    let fourth = |x2: f64, xx: f64| x2 * x2 - 6.0 * x2 * xx + 3.0 * xx * xx;
    let mixed = a2 * b2 - a2 * vv - b2 * uu - 4.0 * ab * uv + uu * vv + 2.0 * uv * uv;
    let factor = 1.0 + second / 24.0 + (fourth(a2, uu) + fourth(b2, vv)) / 1920.0 + mixed / 576.0;
    u.perp_dot(v).abs() * factor * (-0.5 * z.length_squared()).exp() / TAU
}

/// Integral of `N(x) erf(y / sqrt 2) / 2` by x, along the side from `p` to `q`.
fn below_side(p: DVec2, q: DVec2) -> f64 {
    let run = q - p;
    if run.x == 0.0 {
        return 0.0;
    }
    let steps = (run.abs().max_element() / STEP).ceil().max(1.0);
    let half = 0.5 * run / steps;
    let at = |z: DVec2| (-0.5 * z.x * z.x).exp() * libm::erf(FRAC_1_SQRT_2 * z.y);
    let mut sum = 0.0;
    for step in 0..steps as u32 {
        let middle = p + (2.0 * f64::from(step) + 1.0) * half;
        for (node, weight) in NODES {
            sum += weight * (at(middle - node * half) + at(middle + node * half));
        }
    }
    0.5 * half.x * sum / TAU.sqrt()
}

/// The normal distribution cut at +-RADIUS, at the quantile `u` in [0, 1].
fn truncated_normal(u: f64) -> f64 {
    let target = ((2.0 * u - 1.0) * KEPT.sqrt()).abs();
    // Newton's method from the left: erf is concave on positive numbers, so that no step goes too far.
    let mut z = 0.0;
    for _ in 0..32 {
        let missing = target - libm::erf(z * FRAC_1_SQRT_2);
        let step = missing * (0.5 * PI).sqrt() * (0.5 * z * z).exp();
        z += step;
        if step < 1e-12 {
            break;
        }
    }
    z.clamp(0.0, RADIUS).copysign(u - 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn vector(range: f64) -> impl Strategy<Value = DVec2> {
        (-range..range, -range..range).prop_map(|(x, y)| DVec2::new(x, y))
    }

    fn gaussian(deviation: f64) -> FootprintFilter {
        FootprintFilter::gaussian(deviation as f32).unwrap()
    }

    /// Weights of all texels of the map, row by row.
    fn weights(filter: FootprintFilter, footprint: &Footprint) -> Vec<f64> {
        let (width, height) = (footprint.map_size().x as u32, footprint.map_size().y as u32);
        let mut weights = vec![0.0; (width * height) as usize];
        filter.over(footprint).for_each_part(|part| match part {
            FilteredPart::Texel { column, row } => weights[(row * width + column) as usize] += 1.0,
            FilteredPart::Whole(weight) => weights.iter_mut().for_each(|w| *w += weight),
            FilteredPart::Cut(window) => {
                for span in window.texel_spans(width, height) {
                    for column in span.touched.0..span.touched.1 {
                        let is_even = (span.inside.0..span.inside.1).contains(&column);
                        weights[(span.row * i64::from(width) + column) as usize] += match is_even {
                            true => window.even_weight().unwrap(),
                            false => window.texel_weight(column as u32, span.row as u32),
                        };
                    }
                }
            }
        });
        weights
    }

    /// The same by brute force, as shares of the points of a fine grid in the coordinates of the footprint.
    fn shares_of_points(footprint: &Footprint, deviation: f64) -> Vec<f64> {
        const SIDE: usize = 700;
        let (width, height) = (footprint.map_size().x, footprint.map_size().y);
        let mut shares = vec![0.0; (width * height) as usize];
        let [a, b] = footprint.edges();
        let mut total = 0.0;
        for i in 0..SIDE * SIDE {
            let z = (DVec2::new((i % SIDE) as f64, (i / SIDE) as f64) + 0.5) / SIDE as f64 * 8.0 - 4.0;
            let share = (-0.5 * z.length_squared()).exp();
            let point = footprint.center() + deviation * (z.x * a + z.y * b);
            let column = point.x.rem_euclid(width).floor().min(width - 1.0);
            let row = point.y.rem_euclid(height).floor().min(height - 1.0);
            shares[(row * width + column) as usize] += share;
            total += share;
        }
        shares.iter().map(|share| share / total).collect()
    }

    fn distance(a: &[f64], b: &[f64]) -> f64 {
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        #[test]
        fn weights_sum_to_one(
            c in vector(50.0), a in vector(30.0), b in vector(30.0), scale in 0.0001..3.0, deviation in 0.05..4.0,
            width in 1..40u32, height in 1..40u32,
        ) {
            let footprint = Footprint::in_texels(width, height, c, a * scale, b * scale);
            let sum: f64 = weights(gaussian(deviation), &footprint).iter().sum();
            prop_assert!((sum - 1.0).abs() < 2e-6, "{sum}");
        }

        #[test]
        fn thin_footprints_have_weights_too(
            c in vector(50.0), a in vector(60.0), factor in -1.0..1.0, deviation in 0.05..0.6,
        ) {
            for b in [DVec2::ZERO, a * factor, a] {
                let footprint = Footprint::in_texels(16, 24, c, a, b);
                let sum: f64 = weights(gaussian(deviation), &footprint).iter().sum();
                prop_assert!((sum - 1.0).abs() < 1e-5, "{sum}");
            }
        }

        #[test]
        fn whole_periods_change_nothing(
            u in 0..64_i32, v in 0..64_i32, periods in (-5..5_i32, -5..5_i32), a in vector(0.6), b in vector(0.6),
            deviation in 0.05..1.0,
        ) {
            let over = |x: i32, y: i32| {
                let uv = [u as f32 / 64.0 + x as f32, v as f32 / 64.0 + y as f32];
                let edges = [a, b].map(|e| e.as_vec2().to_array());
                weights(gaussian(deviation), &Footprint::new(16, 32, uv, edges[0], edges[1]))
            };
            prop_assert_eq!(over(0, 0), over(periods.0, periods.1));
        }

        #[test]
        fn rectangles_weigh_what_their_texels_do(
            c in vector(20.0), a in vector(9.0), b in vector(9.0), deviation in 0.1..1.0, low in (-9..20_i32, -9..20_i32),
            extent in (1..9_i32, 1..9_i32), is_box: bool,
        ) {
            let footprint = Footprint::in_texels(4000, 4000, c + 2000.0, a, b);
            let filter = if is_box { FootprintFilter::Box } else { gaussian(deviation) };
            filter.over(&footprint).for_each_part(|part| {
                let FilteredPart::Cut(window) = part else { panic!("{part:?}") };
                let low = DVec2::new(low.0.into(), low.1.into()) + 2000.0;
                let high = low + DVec2::new(extent.0.into(), extent.1.into());
                let whole = window.weight(low, high);
                let bounds = window.density_bounds(low, high);
                let mut sum = 0.0;
                for (x, y) in (0..extent.0).flat_map(|x| (0..extent.1).map(move |y| (x, y))) {
                    let weight = window.texel_weight((low.x as i32 + x) as u32, (low.y as i32 + y) as u32);
                    let rounding = 1e-9 + 1e-6 * bounds.1;
                    assert!((bounds.0 - rounding..bounds.1 + rounding).contains(&weight), "{weight} {bounds:?}");
                    sum += weight;
                }
                assert!((whole - sum).abs() < 1e-6, "{whole} {sum}");
                match window.coverage(low, high) {
                    Coverage::Outside => assert_eq!((whole, bounds), (0.0, (0.0, 0.0))),
                    Coverage::Inside => assert_eq!(bounds, [window.even_weight().unwrap(); 2].into()),
                    Coverage::Cut => assert_eq!(bounds.0 > 0.0, !is_box && window.region.coverage(low, high) == Coverage::Inside),
                }
            });
        }

        #[test]
        fn the_series_is_the_integral(center in vector(3.0), u in vector(0.24), v in vector(0.24)) {
            let corners = [-u - v, u - v, u + v, v - u].map(|corner| center + 0.5 * corner);
            let sides = Polygon::new(&corners);
            let exact: f64 = sides.sides().map(|(p, q)| below_side(p, q)).sum();
            prop_assert!((series(center, u, v) - exact.abs()).abs() < 2e-6 * u.perp_dot(v).abs().max(1e-4));
        }

        #[test]
        fn quantiles_are_those_of_the_cut_normal_distribution(u in 0.0..1.0) {
            let z = truncated_normal(u);
            let found = 0.5 + 0.5 * libm::erf(z * FRAC_1_SQRT_2) / libm::erf(RADIUS * FRAC_1_SQRT_2);
            prop_assert!(z.abs() <= RADIUS && (found - u).abs() < 1e-10, "{z} {found}");
        }
    }

    /// Centre, edges and deviation over a map of 12 x 10 texels: small, wide, turned, thin, closed on itself, of many tiles.
    fn footprints() -> Vec<(Footprint, f64)> {
        let v = DVec2::new;
        let cases = [
            (v(3.02, 4.97), v(0.01, 0.0), v(0.0, 0.02), 0.5),
            (v(3.4, 4.6), v(0.8, 0.3), v(-0.2, 0.7), 0.5),
            (v(0.2, 9.9), v(3.0, 0.0), v(0.0, 2.0), 0.288_675),
            (v(7.7, 0.1), v(4.0, 3.0), v(-2.0, 3.0), 0.5),
            (v(7.7, 0.1), v(4.0, 3.0), v(-0.02, 0.03), 1.0),
            (v(5.0, 5.0), v(5.0, 3.0), v(0.0, 0.0), 0.4),
            (v(5.0, 5.0), v(24.0, 10.0), v(0.3, 0.4), 0.5),
            (v(1.0, 2.0), v(14.0, 2.0), v(-3.0, 11.0), 0.5),
            (v(1.0, 2.0), v(70.0, 2.0), v(-3.0, 60.0), 0.5),
            (v(1.0, 2.0), v(0.0, 0.0), v(0.0, 0.0), 0.5),
        ];
        let footprint = |(c, a, b, deviation)| (Footprint::in_texels(12, 10, c, a, b), deviation);
        cases.into_iter().map(footprint).collect()
    }

    #[test]
    fn weights_are_the_shares_of_points() {
        for (case, (footprint, deviation)) in footprints().into_iter().enumerate() {
            let expected = shares_of_points(&footprint, deviation);
            let error = distance(&weights(gaussian(deviation), &footprint), &expected);
            // Of the grid, 700 x 700 points, and the truncation, 7e-4.
            assert!(error < 0.012, "{footprint:?}: {error}");
            // The twin: the box is another filter, except of what lies in a texel or covers the map.
            let twin = distance(&weights(FootprintFilter::Box, &footprint), &expected);
            assert!(twin > 0.08 || !(1..=5).contains(&case), "{footprint:?}: {twin}");
        }
    }

    /// The integral of the Gaussian over a texel, by the midpoint rule over 128 x 128 points, from its covariance.
    fn exact_weight(c: DVec2, [a, b]: [DVec2; 2], deviation: f64, texel: DVec2) -> f64 {
        const SIDE: usize = 128;
        let variance = deviation * deviation;
        let (xx, yy) = (
            variance * (a.x * a.x + b.x * b.x),
            variance * (a.y * a.y + b.y * b.y),
        );
        let xy = variance * (a.x * a.y + b.x * b.y);
        let determinant = xx * yy - xy * xy;
        let mut sum = 0.0;
        for i in 0..SIDE * SIDE {
            let inner = (DVec2::new((i % SIDE) as f64, (i / SIDE) as f64) + 0.5) / SIDE as f64;
            let d = texel + inner - c;
            let form = (yy * d.x * d.x - 2.0 * xy * d.x * d.y + xx * d.y * d.y) / determinant;
            sum += (-0.5 * form).exp();
        }
        sum / ((SIDE * SIDE) as f64 * TAU * determinant.sqrt())
    }

    #[test]
    fn weights_are_integrals_over_texels() {
        let v = DVec2::new;
        for (a, b, deviation) in [
            (v(1.6, 0.7), v(-0.4, 1.9), 0.5),
            (v(3.0, 0.0), v(0.0, 4.0), 0.5),
            (v(8.0, 5.0), v(-1.0, 6.0), 0.4),
            (v(9.0, 4.0), v(8.0, 4.5), 0.5),
            (v(12.0, 0.0), v(0.0, 13.0), 0.5),
        ] {
            let center = v(32.3, 31.8);
            let footprint = Footprint::in_texels(64, 64, center, a, b);
            let found = weights(gaussian(deviation), &footprint);
            let mut worst = 0.0_f64;
            for i in 0..40 * 40 {
                let texel = v((12 + i % 40) as f64, (12 + i / 40) as f64);
                let found = found[64 * texel.y as usize + texel.x as usize];
                let expected = exact_weight(center, [a, b], deviation, texel) / KEPT;
                // Where the truncation does not reach.
                if expected > 0.05 * peak(&footprint, deviation) {
                    worst = worst.max((found / expected - 1.0).abs());
                }
            }
            assert!(worst < 2e-4, "{a} {b}: {worst}");
        }
    }

    /// The density at the centre.
    fn peak(footprint: &Footprint, deviation: f64) -> f64 {
        1.0 / (TAU * deviation * deviation * footprint.area())
    }

    #[test]
    fn texels_are_drawn_with_their_weights() {
        const SIDE: usize = 800;
        for (footprint, deviation) in footprints() {
            let filtered = gaussian(deviation).over(&footprint);
            let mut shares = vec![0.0; 120];
            for i in 0..SIDE * SIDE {
                let u = [i % SIDE, i / SIDE].map(|k| (k as f64 + 0.5) / SIDE as f64);
                let (column, row) = filtered.sample_texel(u);
                shares[(row * 12 + column) as usize] += 1.0 / (SIDE * SIDE) as f64;
            }
            let error = distance(&shares, &weights(gaussian(deviation), &footprint));
            assert!(error < 0.01, "{footprint:?}: {error}");
        }
    }

    #[test]
    fn huge_footprints_are_bounded() {
        for (a, b, deviation) in [([1e9, 1e7], [-1e8, 1e9], 4.0), ([1e9, 1e7], [0.001, 0.002], 0.5)] {
            let footprint = Footprint::new(64, 64, [0.3, 0.3], a, b);
            let mut parts = 0;
            gaussian(deviation).over(&footprint).for_each_part(|_| parts += 1);
            assert!(parts < 200, "{parts}");
            let sum: f64 = weights(gaussian(deviation), &footprint).iter().sum();
            assert!((sum - 1.0).abs() < 1e-5, "{sum}");
        }
    }

    #[test]
    fn deviations_have_a_domain() {
        for wrong in [0.0, 0.04, 4.1, f32::NAN] {
            let message = FootprintFilter::gaussian(wrong).unwrap_err().to_string();
            assert!(
                message.contains("footprint_sigma") && message.contains("0.05"),
                "{message}"
            );
        }
    }
}
