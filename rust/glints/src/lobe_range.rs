//! The lobe of one flake, integrated over a rectangle of the projected disk.
//!
//! **Computes** `integral over [low, high] of D^alpha(h, t) dx dy`, `h = (x, y, sqrt(1 - x^2 - y^2))`: one term of
//! the range query of Deng et al. 2022 (Eq. 7) over the sum of Eq. 11 in Atanasov et al. 2021.
//!
//! A lobe that lies inside the rectangle altogether has the integral `t . n`, exactly: with the slopes `s` of
//! the microfacets in the flake's frame `(e1, e2, t)`, distributed as `p(s)`,
//!
//! ```text
//! D dx dy = D (h . n) dw = p(s) (h . n) / (h . t) ds = p(s) (t.z + s1 e1.z + s2 e2.z) ds,
//! ```
//!
//! and slopes have zero mean. A lobe that is cut is integrated by a product of Gauss-Legendre rules of
//! [`NODES`] nodes between the lobe's centre and its borders, for GGX also between powers of four of the lobe's
//! width, the inner variable up to the disk's rim.
//!
//! **Error** Below 2e-5 of the lobe's integral, and below 2e-3 for lobes that reach the rim of the disk, where the
//! integrand has the shape of a square root. Beckmann's lobe is cut at [`BECKMANN_EXTENT`] alpha, of which 4e-9
//! are left out.

use std::f64::consts::{FRAC_1_SQRT_2, SQRT_2, TAU};

use glam::{DVec2, DVec3, Vec2, Vec3};

use crate::microfacet::{Distribution, Flake};

/// Slopes in units of alpha beyond which nothing of a Beckmann lobe is left: exp(-4.4^2) = 4e-9.
const BECKMANN_EXTENT: f64 = 4.4;

/// Widths in units of alpha between which panels of the quadrature over a GGX lobe lie.
const GGX_PANELS: [f64; 6] = [1.5, 6.0, 24.0, 96.0, 384.0, 1536.0];

/// Largest roughness of a lobe that is taken as flat.
const FLAT_ALPHA: f32 = 0.05;

/// Nodes of a panel of the quadrature.
const NODES: usize = 12;

/// Positive nodes and weights of the Gauss-Legendre rule of 12 nodes on [-1, 1] (Abramowitz and Stegun, Table 25.4).
const GAUSS: [(f64, f64); NODES / 2] = [
    (0.125_233_408_511_468_9, 0.249_147_045_813_402_8),
    (0.367_831_498_998_180_2, 0.233_492_536_538_354_8),
    (0.587_317_954_286_617_5, 0.203_167_426_723_065_9),
    (0.769_902_674_194_304_7, 0.160_078_328_543_346_2),
    (0.904_117_256_370_474_9, 0.106_939_325_995_318_4),
    (0.981_560_634_246_719_3, 0.047_175_336_386_511_8),
];

/// The integral of `D^alpha(h, t)` over the part of `[low, high]` inside the unit disk; zero for an empty
/// rectangle. Units: half vectors' x and y; `t` is a unit vector above the horizon.
pub fn lobe_integral(flake: &Flake, t: Vec3, low: Vec2, high: Vec2) -> f64 {
    let lobe = Lobe::new(flake, t.as_dvec3());
    let (low, high) = (low.as_dvec2().max(lobe.low), high.as_dvec2().min(lobe.high));
    if !low.cmplt(high).all() {
        return 0.0;
    }
    if lobe.is_whole && low == lobe.low && high == lobe.high {
        return lobe.t.z;
    }
    lobe.integral(low, high)
}

/// [`lobe_integral`] within 0.02 of the lobe, at a small part of its time: for sums over many flakes.
///
/// A narrow lobe is a Gaussian on the disk, too: half vectors are `t + s1 e1 + s2 e2` to first order, whose x and y have
/// the covariance `alpha^2 / 2 (1 - t t^T)` and the correlation `rho`. The probability of a rectangle is taken to first order
/// in `rho` (Plackett 1954: `d P / d rho` is the bivariate density). Wide lobes, those that lean by more than 45 degrees,
/// and GGX are integrated as above.
pub fn flat_lobe_integral(flake: &Flake, t: Vec3, low: Vec2, high: Vec2) -> f64 {
    if flake.kind() != Distribution::Beckmann || flake.alpha() > FLAT_ALPHA || t.z * t.z < 0.5 {
        return lobe_integral(flake, t, low, high);
    }
    let centre = t.truncate().as_dvec2();
    let lean = DVec2::ONE - centre * centre;
    let deviation = DVec2::new(lean.x.sqrt(), lean.y.sqrt()) * (f64::from(flake.alpha()) * FRAC_1_SQRT_2);
    let (low, high) = (
        (low.as_dvec2() - centre) / deviation,
        (high.as_dvec2() - centre) / deviation,
    );
    let reach = DVec2::splat(BECKMANN_EXTENT * SQRT_2);
    if !(low.cmplt(high) & low.cmplt(reach) & high.cmpgt(-reach)).all() {
        return 0.0;
    }
    let probability =
        |low: f64, high: f64| 0.5 * (libm::erf(high * FRAC_1_SQRT_2) - libm::erf(low * FRAC_1_SQRT_2));
    let density = |x: f64| (-0.5 * x * x).exp();
    let slope = (density(high.x) - density(low.x)) * (density(high.y) - density(low.y)) / TAU;
    let correlation = -centre.x * centre.y / (lean.x * lean.y).sqrt();
    let product = probability(low.x, high.x) * probability(low.y, high.y);
    f64::from(t.z) * (product + correlation * slope).max(0.0)
}

/// A flake's lobe and the box on the disk outside of which it is zero.
struct Lobe<'a> {
    flake: &'a Flake,
    t: DVec3,
    low: DVec2,
    high: DVec2,
    /// Whether all of it is above the horizon.
    is_whole: bool,
}

impl<'a> Lobe<'a> {
    fn new(flake: &'a Flake, t: DVec3) -> Self {
        // A cone about t: half vectors within it have x between those of t turned by its angle.
        let (sin, cos) = match flake.kind() {
            Distribution::Beckmann => {
                let tan = BECKMANN_EXTENT * f64::from(flake.alpha());
                let cos = 1.0 / (1.0 + tan * tan).sqrt();
                (tan * cos, cos)
            }
            Distribution::Ggx => (1.0, 0.0),
        };
        let upper = |x: f64| {
            if x >= cos {
                1.0
            } else {
                (x * cos + (1.0 - x * x).max(0.0).sqrt() * sin).min(1.0)
            }
        };
        Self {
            flake,
            t,
            low: -DVec2::new(upper(-t.x), upper(-t.y)),
            high: DVec2::new(upper(t.x), upper(t.y)),
            is_whole: t.z > sin,
        }
    }

    fn integral(&self, low: DVec2, high: DVec2) -> f64 {
        self.over_panels(low.x, high.x, self.t.x, |x| {
            let rim = (1.0 - x * x).max(0.0).sqrt();
            self.over_panels(low.y.max(-rim), high.y.min(rim), self.t.y, |y| {
                let h = DVec3::new(x, y, (1.0 - x * x - y * y).max(0.0).sqrt());
                let chord2 = (h - self.t).length_squared();
                f64::from(self.flake.distribution_at_chord2(chord2 as f32).0)
            })
        })
    }

    /// The integral of `f` from `low` to `high`, in panels about the lobe's centre.
    fn over_panels(&self, low: f64, high: f64, center: f64, f: impl Fn(f64) -> f64) -> f64 {
        let alpha = f64::from(self.flake.alpha());
        let widths: &[f64] = match self.flake.kind() {
            Distribution::Beckmann => &[1.5],
            Distribution::Ggx => &GGX_PANELS,
        };
        let below = widths.iter().rev().map(|width| center - width * alpha);
        let above = widths.iter().map(|width| center + width * alpha);
        let mut start = low;
        let mut sum = 0.0;
        for end in below.chain([center]).chain(above).chain([high]) {
            let end = end.min(high);
            if end > start {
                sum += gauss(start, end, &f);
                start = end;
            }
        }
        sum
    }
}

fn gauss(low: f64, high: f64, f: impl Fn(f64) -> f64) -> f64 {
    let (center, half) = (0.5 * (low + high), 0.5 * (high - low));
    let both = |&(node, weight): &(f64, f64)| weight * (f(center - half * node) + f(center + half * node));
    half * GAUSS.iter().map(both).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    /// The same integral by points of the lobe itself: `p(s)` is drawn, on a stratified grid, and `(h . n) / (h . t)`
    /// is its weight inside the rectangle. Error about 1e-3 of the lobe.
    fn drawn(flake: &Flake, t: Vec3, low: Vec2, high: Vec2) -> f64 {
        const SIDE: usize = 1500;
        let mut sum = 0.0;
        for i in 0..SIDE * SIDE {
            let u = [i % SIDE, i / SIDE].map(|k| (k as f32 + 0.5) / SIDE as f32);
            let h = flake.sample(t, u);
            let inside = h.z > 0.0 && h.truncate().cmpge(low).all() && h.truncate().cmple(high).all();
            if inside {
                sum += f64::from(h.z) / f64::from(h.dot(t)).max(1e-6);
            }
        }
        sum / (SIDE * SIDE) as f64
    }

    fn flakes() -> [Flake; 4] {
        [
            (Distribution::Beckmann, 0.01),
            (Distribution::Beckmann, 0.3),
            (Distribution::Ggx, 0.01),
            (Distribution::Ggx, 0.3),
        ]
        .map(|(kind, alpha)| Flake::new(kind, alpha).unwrap())
    }

    #[test]
    fn integrals_are_the_shares_of_drawn_normals() {
        let t = Vec3::new(0.35, -0.2, 1.0).normalize();
        for flake in flakes() {
            let a = flake.alpha();
            for (low, high) in [
                // Through the centre, a corner, beside it, across the whole disk, a thin one.
                (Vec2::new(-0.3, -2.0) * a, Vec2::new(0.8, 2.0) * a),
                (Vec2::new(0.1, 0.2) * a, Vec2::new(3.0, 2.0) * a),
                (Vec2::new(-2.0, 1.0) * a, Vec2::new(1.0, 1.5) * a),
                (Vec2::new(-9.0, -0.5), Vec2::new(0.2, 0.5)),
                (Vec2::new(-0.05, -9.0) * a, Vec2::new(0.05, 9.0) * a),
            ] {
                let (low, high) = (t.truncate() + low, t.truncate() + high);
                let found = lobe_integral(&flake, t, low, high);
                assert_relative_eq!(found, drawn(&flake, t, low, high), epsilon = 2e-3);
                assert!(found > 0.01, "{found}");
            }
        }
    }

    #[test]
    fn the_whole_lobe_is_its_projected_area() {
        for t in [Vec3::Z, Vec3::new(0.35, -0.2, 1.0).normalize()] {
            for alpha in [0.001, 0.01, 0.1, 0.2] {
                let flake = Flake::new(Distribution::Beckmann, alpha).unwrap();
                let whole = lobe_integral(&flake, t, Vec2::splat(-1.5), Vec2::splat(1.5));
                assert_eq!(whole, f64::from(t.z));
                // By quadrature, cut in two by a line through the lobe.
                let x = t.x + 0.3 * alpha;
                let parts = lobe_integral(&flake, t, Vec2::splat(-1.5), Vec2::new(x, 1.5))
                    + lobe_integral(&flake, t, Vec2::new(x, -1.5), Vec2::splat(1.5));
                assert_relative_eq!(parts, whole, max_relative = 2e-5);
            }
            let flake = Flake::new(Distribution::Ggx, 0.01).unwrap();
            let whole = lobe_integral(&flake, t, Vec2::splat(-1.5), Vec2::splat(1.5));
            // The tail below the horizon is missing, and the square root at the rim has an error.
            assert_relative_eq!(whole, f64::from(t.z), max_relative = 2e-3);
        }
    }

    #[test]
    fn rectangles_are_additive_up_to_the_rim() {
        let t = Vec3::new(0.75, 0.3, 0.4).normalize();
        for flake in flakes() {
            let whole = lobe_integral(&flake, t, Vec2::new(0.2, -0.4), Vec2::new(1.0, 1.0));
            let mut parts = 0.0;
            for (x0, x1) in [(0.2, 0.77), (0.77, 1.0)] {
                for (y0, y1) in [(-0.4, 0.28), (0.28, 0.33), (0.33, 1.0)] {
                    parts += lobe_integral(&flake, t, Vec2::new(x0, y0), Vec2::new(x1, y1));
                }
            }
            assert!(whole > 0.1);
            assert_relative_eq!(parts, whole, max_relative = 2e-3);
        }
    }

    #[test]
    fn flat_lobes_are_close() {
        let (mut worst, mut uncorrelated) = (0.0_f64, 0.0_f64);
        for alpha in [0.002, 0.01, 0.05] {
            let flake = Flake::new(Distribution::Beckmann, alpha).unwrap();
            for t in [
                Vec3::Z,
                Vec3::new(0.3, -0.3, 1.0),
                Vec3::new(0.6, 0.6, 1.0),
                Vec3::new(-0.1, 0.9, 1.0),
            ] {
                let t = t.normalize();
                for (low, high) in [
                    (Vec2::splat(-0.5), Vec2::splat(0.5)),
                    (Vec2::splat(0.0), Vec2::splat(3.0)),
                    (Vec2::new(-3.0, 0.2), Vec2::new(-0.1, 4.0)),
                    (Vec2::new(-9.0, -0.6), Vec2::new(0.3, 9.0)),
                    (Vec2::splat(-9.0), Vec2::splat(9.0)),
                    (Vec2::splat(7.0), Vec2::splat(9.0)),
                ] {
                    let (low, high) = (t.truncate() + alpha * low, t.truncate() + alpha * high);
                    let expected = lobe_integral(&flake, t, low, high);
                    worst = worst.max((flat_lobe_integral(&flake, t, low, high) - expected).abs());
                    // Twin: the same lobe upright, without correlation.
                    let shift = t.truncate();
                    let upright = flat_lobe_integral(&flake, Vec3::Z, low - shift, high - shift);
                    uncorrelated = uncorrelated.max((upright * f64::from(t.z) - expected).abs());
                }
            }
        }
        println!("flat lobes: {worst:.4}, upright ones {uncorrelated:.4}");
        assert!(worst < 0.02 && uncorrelated > 0.04, "{worst} {uncorrelated}");
        // Where it does not hold, the integral itself.
        let leaning = Vec3::new(1.2, 0.0, 1.0).normalize();
        for flake in flakes() {
            let (low, high) = (leaning.truncate() - 0.01, leaning.truncate() + 0.005);
            let expected = lobe_integral(&flake, leaning, low, high);
            assert_eq!(flat_lobe_integral(&flake, leaning, low, high), expected);
        }
        let invalid = flat_lobe_integral(&flakes()[0], Vec3::Z, Vec2::splat(f32::NAN), Vec2::splat(1.0));
        assert_eq!(invalid, 0.0);
    }

    #[test]
    fn nothing_is_found_where_nothing_is() {
        let flake = Flake::new(Distribution::Beckmann, 0.01).unwrap();
        let far = lobe_integral(&flake, Vec3::Z, Vec2::splat(0.2), Vec2::splat(0.3));
        let empty = lobe_integral(&flake, Vec3::Z, Vec2::splat(0.0), Vec2::new(0.0, 1.0));
        let invalid = lobe_integral(&flake, Vec3::Z, Vec2::splat(f32::NAN), Vec2::splat(1.0));
        assert_eq!((far, empty), (0.0, 0.0));
        assert!(invalid.is_finite());
    }
}
