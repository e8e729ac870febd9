//! Sums over truncated lobes, eight normals at a time.
//!
//! A lobe is the flake's distribution about a normal t, cut off at `tan^2(h, t) = R alpha^2` and scaled by one over the
//! mass inside, so that it integrates to one against the cosine and can be sampled exactly. `R` is
//! [`BECKMANN_REACH`], which moves 0.2 % of the energy inwards, or [`GGX_REACH`], which moves the 2 % of GGX's heavy
//! tail.

use glam::Vec3;
use wide::{CmpGe, CmpGt, CmpLe, CmpLt, f32x8};

use super::grid::Grid;
use super::lanes::{compress, eight, mask, places};
use crate::flakes::{FlakeModel, Normalization};
use crate::half_vector::DirectionPair;
use crate::methods::Reflection;
use crate::microfacet::Distribution;

/// `tan^2 / alpha^2` at which a Beckmann lobe ends; outside lies `exp(-R)` of it.
pub const BECKMANN_REACH: f64 = 6.25;

/// `tan^2 / alpha^2` at which a GGX lobe ends; outside lies `1 / (1 + R)` of it.
pub const GGX_REACH: f64 = 49.0;

/// Eight unit normals.
#[derive(Clone, Copy)]
pub struct Normals {
    pub x: f32x8,
    pub y: f32x8,
    pub z: f32x8,
}

/// The truncated lobe of one roughness.
#[derive(Clone, Copy, Debug)]
pub struct Lobe {
    distribution: Distribution,
    alpha2: f32,
    /// Share of the untruncated lobe that is kept.
    mass: f32,
    max_chord2: f32,
    /// `1 / alpha^2`.
    sharpness: f32,
    /// `1 / (pi alpha^2 mass)`.
    peak: f32,
}

impl Lobe {
    pub fn new(distribution: Distribution, alpha2: f64) -> Self {
        let (reach, mass) = match distribution {
            Distribution::Beckmann => (BECKMANN_REACH, 1.0 - (-BECKMANN_REACH).exp()),
            Distribution::Ggx => (GGX_REACH, GGX_REACH / (1.0 + GGX_REACH)),
        };
        Self {
            distribution,
            alpha2: alpha2 as f32,
            mass: mass as f32,
            max_chord2: chord2(reach * alpha2) as f32,
            sharpness: (1.0 / alpha2) as f32,
            peak: (1.0 / (std::f64::consts::PI * alpha2 * mass)) as f32,
        }
    }

    /// Chord `|h - t|` at which the lobe ends.
    pub fn reach(&self) -> f32 {
        self.max_chord2.sqrt()
    }

    /// Draws a normal about `t` with the lobe's density per solid angle, `D (m . t)`.
    #[inline]
    pub fn sample(&self, t: Vec3, u: [f32; 2]) -> Vec3 {
        let (x, y) = t.any_orthonormal_pair();
        self.sample_along(t, [x, y], u)
    }

    /// The same for a lobe that is stretched along the axes: they are orthogonal to `t` and to each other, and as long as
    /// the lobe is stretched.
    #[inline]
    pub fn sample_along(&self, t: Vec3, axes: [Vec3; 2], u: [f32; 2]) -> Vec3 {
        let rest = 1.0 - u[0] * self.mass;
        let tan2 = self.alpha2
            * match self.distribution {
                Distribution::Beckmann => -rest.ln(),
                Distribution::Ggx => (1.0 - rest) / rest,
            };
        let (sin_phi, cos_phi) = (std::f32::consts::TAU * u[1]).sin_cos();
        (t + tan2.sqrt() * (axes[0] * cos_phi + axes[1] * sin_phi)).normalize()
    }

    /// `1 / alpha^2`.
    pub fn sharpness(&self) -> f32 {
        self.sharpness
    }

    /// `1 / (pi alpha^2)`, over the share that is kept.
    pub fn peak(&self) -> f32 {
        self.peak
    }

    /// `tan^2 / alpha^2` at which the lobe ends.
    pub fn limit(&self) -> f32 {
        let reach = match self.distribution {
            Distribution::Beckmann => BECKMANN_REACH,
            Distribution::Ggx => GGX_REACH,
        };
        reach as f32
    }
}

/// Squared chord of two unit vectors with `tan^2` of the angle between them.
fn chord2(tan2: f64) -> f64 {
    2.0 - 2.0 / (1.0 + tan2).sqrt()
}

/// What is asked at one half vector.
#[derive(Clone, Copy)]
pub struct Query {
    pub half: Vec3,
    /// For the flakes' shadowing; `None`: nothing shadows.
    directions: Option<(Vec3, Vec3)>,
    projected: bool,
    distribution: Distribution,
    /// Of the flakes, for their shadowing.
    alpha2: f32,
    /// Cosine from which a Beckmann flake does not shadow.
    unshadowed: f32,
}

/// Cells of normals, of which those in `lanes` may be within reach.
pub struct Near {
    pub lanes: u32,
    pub x: f32x8,
    pub y: f32x8,
}

/// Value, which is the distribution of normals or, with directions, the reflection; and density; see
/// [`crate::methods::Method`].
#[derive(Clone, Copy)]
pub struct Terms {
    pub value: f32x8,
    pub density: f32x8,
}

impl Query {
    pub fn reflection(model: &FlakeModel, lobe: &Lobe, pair: &DirectionPair) -> Self {
        let query = Self::distribution(model, pair.half);
        // No flake within reach of the half vector may shadow; then the distribution of normals says it all.
        let is_clear = |v: Vec3| v.dot(pair.half) - lobe.reach() >= query.unshadowed;
        let clear = model.flake.kind() == Distribution::Beckmann && is_clear(pair.wi) && is_clear(pair.wo);
        Self {
            directions: (!clear).then_some((pair.wi, pair.wo)),
            ..query
        }
    }

    pub fn distribution(model: &FlakeModel, half: Vec3) -> Self {
        let alpha2 = model.flake.alpha() * model.flake.alpha();
        // 1.6 alpha tan = 1, where the rational approximation begins.
        let tan2 = 1.0 / (1.6 * 1.6 * alpha2);
        Self {
            unshadowed: 1.0 / (1.0 + tan2).sqrt(),
            half,
            directions: None,
            projected: model.normalization == Normalization::Projected,
            distribution: model.flake.kind(),
            alpha2,
        }
    }

    /// Squared chords to eight normals.
    #[inline]
    pub fn chord2(&self, t: &Normals) -> f32x8 {
        let (dx, dy, dz) = (t.x - self.half.x, t.y - self.half.y, t.z - self.half.z);
        dx.mul_add(dx, dy.mul_add(dy, dz * dz))
    }

    /// The terms of eight normals of weight one. The angle comes from the chord, which single precision resolves at any
    /// roughness.
    #[inline]
    fn texels(&self, lobe: &Lobe, t: &Normals, chord2: f32x8) -> Terms {
        let cos = 1.0 - 0.5 * chord2;
        let sin2 = chord2 * (1.0 - 0.25 * chord2);
        self.terms(sin2 * lobe.sharpness, f32x8::splat(lobe.peak), cos, t)
    }

    /// The terms of eight normals whose lobes have the peak `peak` and are at `tan^2 / alpha^2 = x / cos^2`, `cos` being the
    /// cosine to the half vector.
    #[inline]
    pub fn terms(&self, x: f32x8, peak: f32x8, cos: f32x8, t: &Normals) -> Terms {
        let z = if self.projected { t.z } else { f32x8::ONE };
        let cos2 = cos * cos;
        // One division for both.
        let inv = 1.0 / (cos2 * z);
        let (inv_cos2, inv_z) = (inv * z, inv * cos2);
        let x = x * inv_cos2;
        let shape = match self.distribution {
            Distribution::Beckmann => exp_minus(x),
            Distribution::Ggx => 1.0 / ((1.0 + x) * (1.0 + x)),
        };
        let lobe = shape * peak * (inv_cos2 * inv_cos2);
        let ndf = lobe * inv_z;
        let value = match self.directions {
            Some((wi, wo)) => ndf * self.smith_g1(wi, t) * self.smith_g1(wo, t),
            None => ndf,
        };
        Terms {
            value,
            density: lobe * cos,
        }
    }

    /// Smith's G1 of a flake, as [`crate::microfacet::Flake::smith_g1`].
    #[inline]
    fn smith_g1(&self, v: Vec3, t: &Normals) -> f32x8 {
        let cos =
            t.x.mul_add(f32x8::splat(v.x), t.y.mul_add(f32x8::splat(v.y), t.z * v.z));
        // Far from grazing, Beckmann's is one for all eight.
        if self.distribution == Distribution::Beckmann && cos.cmp_ge(f32x8::splat(self.unshadowed)).all() {
            return f32x8::ONE;
        }
        let cos2 = (cos * cos).fast_max(f32x8::splat(1e-30));
        let x = (1.0 - cos2).fast_max(f32x8::ZERO) / cos2 * self.alpha2;
        let g1 = match self.distribution {
            Distribution::Beckmann => {
                let a = 1.0 / x.fast_max(f32x8::splat(1e-30)).sqrt();
                let rational = a * a.mul_add(f32x8::splat(2.181), f32x8::splat(3.535))
                    / a.mul_add(a.mul_add(f32x8::splat(2.577), f32x8::splat(2.276)), f32x8::ONE);
                (x * (1.6 * 1.6)).cmp_le(f32x8::ONE).blend(f32x8::ONE, rational)
            }
            Distribution::Ggx => 2.0 / (1.0 + (1.0 + x).sqrt()),
        };
        cos.cmp_gt(f32x8::ZERO).blend(g1, f32x8::ZERO)
    }
}

/// `exp(-x)` for x from 0 to [`BECKMANN_REACH`], to 1e-5 of its value: a Taylor polynomial of `exp(-x / 16)`, squared four
/// times. Beyond, it is of no use, and finite.
#[inline]
fn exp_minus(x: f32x8) -> f32x8 {
    let y = x.fast_min(f32x8::splat(2.0 * BECKMANN_REACH as f32)) * (-1.0 / 16.0);
    let mut sum = f32x8::splat(1.0 / 720.0);
    for coefficient in [1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        sum = sum.mul_add(y, f32x8::splat(coefficient));
    }
    for _ in 0..4 {
        sum = sum * sum;
    }
    sum
}

/// Sums of terms, and of texels' lobes.
///
/// Few of eight neighbouring texels are near the half vector; those that are wait in a queue, so that lobes are computed
/// for eight at a time that all count.
pub struct Sums {
    pub query: Query,
    lobe: Lobe,
    grid: Grid,
    /// The half vector's projection and the lobe's reach, in cells of the grid.
    center: [f32; 2],
    radius2: f32,
    value: f32x8,
    density: f32x8,
    x: [f32; QUEUE],
    y: [f32; QUEUE],
    weights: [f32; QUEUE],
    len: usize,
}

/// Room for whole groups of eight.
const QUEUE: usize = 128;

impl Sums {
    /// `grid`: the one that normals are quantised to.
    pub fn new(query: Query, lobe: Lobe, grid: Grid) -> Self {
        let center = (query.half.truncate() - grid.low) / grid.pitch - 0.5;
        Self {
            query,
            lobe,
            grid,
            center: center.to_array(),
            radius2: lobe.max_chord2 / (grid.pitch * grid.pitch),
            value: f32x8::ZERO,
            density: f32x8::ZERO,
            x: [0.0; QUEUE],
            y: [0.0; QUEUE],
            weights: [0.0; QUEUE],
            len: 0,
        }
    }

    /// Bit k: the normal in cell `(x, y)` of lane k may be within reach; its projection is.
    #[inline(always)]
    pub fn near(&self, x: f32x8, y: f32x8) -> u32 {
        let (dx, dy) = (x - self.center[0], y - self.center[1]);
        let flat = dx.mul_add(dx, dy * dy);
        flat.cmp_lt(f32x8::splat(self.radius2)).move_mask() as u32
    }

    /// Adds the lobes of the normals in cells `(x, y)` of `lanes` that weigh more than nothing, with their weights.
    #[inline(always)]
    pub fn add(&mut self, lanes: u32, x: f32x8, y: f32x8, weights: f32x8) {
        let lanes = lanes & weights.cmp_gt(f32x8::ZERO).move_mask() as u32;
        compress(lanes, x, &mut self.x, self.len);
        compress(lanes, y, &mut self.y, self.len);
        compress(lanes, weights, &mut self.weights, self.len);
        self.taken(lanes);
    }

    /// The same, all of one weight.
    #[inline(always)]
    pub fn add_alike(&mut self, lanes: u32, x: f32x8, y: f32x8, weight: f32) {
        compress(lanes, x, &mut self.x, self.len);
        compress(lanes, y, &mut self.y, self.len);
        *places(&mut self.weights, self.len) = [weight; 8];
        self.taken(lanes);
    }

    #[inline(always)]
    fn taken(&mut self, lanes: u32) {
        self.len += lanes.count_ones() as usize;
        if self.len > QUEUE - 8 {
            self.flush();
        }
    }

    /// Adds what waits in the queue.
    #[inline(never)]
    fn flush(&mut self) {
        for start in (0..self.len).step_by(8) {
            let lanes = (1 << (self.len - start).min(8)) - 1;
            let x = self.grid.middle(0, eight(&self.x, start));
            let y = self.grid.middle(1, eight(&self.y, start));
            self.add_lobes(x, y, eight(&self.weights, start) & mask(lanes));
        }
        self.len = 0;
    }

    /// Adds the lobes of the normals over `(x, y)`.
    #[inline(always)]
    fn add_lobes(&mut self, x: f32x8, y: f32x8, weights: f32x8) {
        let t = Normals { x, y, z: lift(x, y) };
        let chord2 = self.query.chord2(&t);
        let inside = chord2.cmp_lt(f32x8::splat(self.lobe.max_chord2));
        // Terms out of reach have weight zero, and must be finite: at a right angle they would not be.
        let near = chord2.fast_min(f32x8::splat(self.lobe.max_chord2));
        let terms = self.query.texels(&self.lobe, &t, near);
        let weights = weights & inside;
        self.value = terms.value.mul_add(weights, self.value);
        self.density = terms.density.mul_add(weights, self.density);
    }

    /// Adds terms times weights.
    #[inline]
    pub fn add_terms(&mut self, terms: &Terms, weights: f32x8) {
        // Terms of weight zero may be infinite.
        let used = weights.cmp_gt(f32x8::ZERO);
        let weighted = |term: f32x8, sum: f32x8| (term & used).mul_add(weights, sum);
        self.value = weighted(terms.value, self.value);
        self.density = weighted(terms.density, self.density);
    }

    /// The half vector's projection, and what is within reach of it, in cells of the grid.
    pub fn window(&self) -> ([f32; 2], f32) {
        (self.center, self.radius2.sqrt())
    }

    /// Chord within which texels count.
    #[inline]
    pub fn reach(&self) -> f32 {
        self.lobe.reach()
    }

    /// Value and density, times `scale`.
    pub fn totals(&mut self, scale: f32) -> Reflection {
        self.flush();
        Reflection {
            value: self.value.reduce_add() * scale,
            density: self.density.reduce_add() * scale,
        }
    }
}

/// `z` of the unit vectors over `(x, y)`; quantisation may leave the disk.
#[inline]
pub fn lift(x: f32x8, y: f32x8) -> f32x8 {
    let z2 = 1.0 - x.mul_add(x, y * y);
    z2.fast_max(f32x8::splat(LEAST_Z * LEAST_Z)).sqrt()
}

/// The normal over `(x, y)`, as [`lift`] sees it.
pub fn lifted(x: f32, y: f32) -> Vec3 {
    let z2 = 1.0 - x.mul_add(x, y * y);
    Vec3::new(x, y, z2.max(LEAST_Z * LEAST_Z).sqrt())
}

/// Normals of maps have at least this z.
const LEAST_Z: f32 = 1e-3;
