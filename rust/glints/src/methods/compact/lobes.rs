//! Sums over truncated lobes, eight normals at a time.
//!
//! A lobe is the flake's distribution about a normal t, cut off at `tan^2(h, t) = R alpha^2` and scaled by one over the
//! mass inside, so that it integrates to one against the cosine and can be sampled exactly. `R` is
//! [`BECKMANN_REACH`], which moves 0.2 % of the energy inwards, or [`GGX_REACH`], which moves the 2 % of GGX's heavy
//! tail.

use glam::Vec3;
use wide::{CmpGe, CmpGt, CmpLe, CmpLt, f32x8, u32x8};

use crate::flakes::{FlakeModel, Normalization};
use crate::half_vector::DirectionPair;
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
    /// For the flakes' shadowing; `None`: the distribution of normals and its density alone.
    directions: Option<(Vec3, Vec3)>,
    projected: bool,
    distribution: Distribution,
    /// Of the flakes, for their shadowing.
    alpha2: f32,
    /// Cosine from which a Beckmann flake does not shadow.
    unshadowed: f32,
}

/// Value with shadowing, density, and distribution of normals; see [`crate::methods::Method`].
#[derive(Clone, Copy)]
pub struct Terms {
    pub value: f32x8,
    pub density: f32x8,
    pub ndf: f32x8,
}

impl Query {
    pub fn reflection(model: &FlakeModel, pair: &DirectionPair) -> Self {
        Self {
            directions: Some((pair.wi, pair.wo)),
            ..Self::distribution(model, pair.half)
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
        let x = chord2 * (1.0 - 0.25 * chord2) / (cos * cos) * lobe.sharpness;
        self.terms(x, f32x8::splat(lobe.peak), cos, t)
    }

    /// The terms of eight normals whose lobes have the peak `peak` and are at `x = tan^2 / alpha^2`, `cos` being the cosine
    /// to the half vector.
    #[inline]
    pub fn terms(&self, x: f32x8, peak: f32x8, cos: f32x8, t: &Normals) -> Terms {
        let shape = match self.distribution {
            Distribution::Beckmann => exp_minus(x),
            Distribution::Ggx => 1.0 / ((1.0 + x) * (1.0 + x)),
        };
        let cos2 = cos * cos;
        let lobe = shape * peak / (cos2 * cos2);
        let ndf = if self.projected { lobe / t.z } else { lobe };
        let value = match self.directions {
            Some((wi, wo)) => ndf * self.smith_g1(wi, t) * self.smith_g1(wo, t),
            None => f32x8::ZERO,
        };
        Terms {
            value,
            density: lobe * cos,
            ndf,
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
    value: f32x8,
    density: f32x8,
    ndf: f32x8,
    queue: Queue,
}

/// Projected normals and weights of texels to come.
struct Queue {
    x: [f32; QUEUE],
    y: [f32; QUEUE],
    weight: [f32; QUEUE],
    len: usize,
}

/// Of eight normals, so many within reach are worth computing all eight.
const CROWD: u32 = 4;

/// Room for whole groups of eight.
const QUEUE: usize = 64;

impl Sums {
    pub fn new(query: Query, lobe: Lobe) -> Self {
        Self {
            query,
            lobe,
            value: f32x8::ZERO,
            density: f32x8::ZERO,
            ndf: f32x8::ZERO,
            queue: Queue {
                x: [0.0; QUEUE],
                y: [0.0; QUEUE],
                weight: [0.0; QUEUE],
                len: 0,
            },
        }
    }

    /// Bit k: the normal over `(x, y)` of lane k may be within reach; its projection is.
    #[inline(always)]
    pub fn near(&self, x: f32x8, y: f32x8) -> u32 {
        let (dx, dy) = (x - self.query.half.x, y - self.query.half.y);
        let flat = dx.mul_add(dx, dy * dy);
        flat.cmp_lt(f32x8::splat(self.lobe.max_chord2)).move_mask() as u32
    }

    /// Adds the lobes of the normals over `(x, y)` in `lanes`, with their weights.
    #[inline]
    pub fn add(&mut self, lanes: u32, x: f32x8, y: f32x8, weights: f32x8) {
        if lanes.count_ones() >= CROWD {
            return self.add_lobes(lanes, x, y, weights);
        }
        let queue = &mut self.queue;
        let (x, y, weights) = (x.to_array(), y.to_array(), weights.to_array());
        let mut len = queue.len;
        for k in bits(lanes) {
            // Whole groups leave before the queue is full; the remainder is for the compiler.
            let place = len % QUEUE;
            queue.x[place] = x[k & 7];
            queue.y[place] = y[k & 7];
            queue.weight[place] = weights[k & 7];
            len += 1;
        }
        queue.len = len;
        if queue.len > QUEUE - 8 {
            self.flush();
        }
    }

    /// Adds the lobes of the normals over `(x, y)` in `lanes` at once.
    #[inline]
    fn add_lobes(&mut self, lanes: u32, x: f32x8, y: f32x8, weights: f32x8) {
        let t = Normals { x, y, z: lift(x, y) };
        let chord2 = self.query.chord2(&t);
        let inside = chord2.cmp_lt(f32x8::splat(self.lobe.max_chord2));
        // Terms out of reach have weight zero, and must be finite: at a right angle they would not be.
        let near = chord2.fast_min(f32x8::splat(self.lobe.max_chord2));
        let terms = self.query.texels(&self.lobe, &t, near);
        let weights = weights & inside & mask(lanes);
        self.value = terms.value.mul_add(weights, self.value);
        self.density = terms.density.mul_add(weights, self.density);
        self.ndf = terms.ndf.mul_add(weights, self.ndf);
    }

    /// Adds what waits in the queue.
    #[cold]
    fn flush(&mut self) {
        let len = self.queue.len;
        for start in (0..len).step_by(8) {
            let eight = |values: &[f32; QUEUE]| f32x8::from(&values[start..start + 8]);
            let Queue { x, y, weight, .. } = &self.queue;
            let (x, y, weight) = (eight(x), eight(y), eight(weight));
            self.add_lobes((1 << (len - start).min(8)) - 1, x, y, weight);
        }
        self.queue.len = 0;
    }

    /// Adds terms times weights.
    #[inline]
    pub fn add_terms(&mut self, terms: &Terms, weights: f32x8) {
        // Terms of weight zero may be infinite.
        let used = weights.cmp_gt(f32x8::ZERO);
        let weighted = |term: f32x8, sum: f32x8| (term & used).mul_add(weights, sum);
        self.value = weighted(terms.value, self.value);
        self.density = weighted(terms.density, self.density);
        self.ndf = weighted(terms.ndf, self.ndf);
    }

    /// Chord within which texels count.
    #[inline]
    pub fn reach(&self) -> f32 {
        self.lobe.reach()
    }

    /// `(value, density, ndf)`.
    pub fn totals(&mut self) -> (f32, f32, f32) {
        self.flush();
        (
            self.value.reduce_add(),
            self.density.reduce_add(),
            self.ndf.reduce_add(),
        )
    }
}

/// The numbers of the lanes.
pub const LANES: f32x8 = f32x8::new([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);

/// The lanes of a bit mask, as a mask of floats.
#[inline]
fn mask(lanes: u32) -> f32x8 {
    let bits = u32x8::new([1, 2, 4, 8, 16, 32, 64, 128]);
    bytemuck::cast((u32x8::splat(lanes) & bits).cmp_eq(bits))
}

/// The positions of the set bits.
#[inline]
pub fn bits(mut mask: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let k = mask.trailing_zeros() as usize;
        mask &= mask.wrapping_sub(1);
        (k < 32).then_some(k)
    })
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
