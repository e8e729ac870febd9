//! Shares of elements under one footprint: the closed forms of the module above.

use std::f64::consts::{PI, TAU};

use glam::{DVec2, Vec2};

use super::tree::{LEAF_SIZE, Leaf};
use super::{LARGEST_EXPONENT, SEED_DEVIATION};
use crate::gaussian_footprint::{GaussianFootprint, Reach, Symmetric};

/// Everything of a query that does not depend on the element.
pub struct Kernel {
    pub gaussian: GaussianFootprint,
    pub reach: Reach,
    /// Q.
    pub q: Symmetric,
    /// H in texels.
    spacing: f32,
    /// W, upper triangular, with `W^T W = Q^-1`; zero if the whole map is covered evenly. A form in Q^-1
    /// itself would lose thin footprints to cancellation.
    whitening: [f32; 3],
    /// `sigma_h^2`.
    blur: f32,
    /// L, what the footprint leaves of a seed's variance.
    rest: [f32; 3],
    variance: f32,
    inv_variance: f32,
    /// Squared distance of normals at which flat elements are truncated.
    max_distance2: f32,
    /// Factor of all shares: of positions and, for flat elements, of normals.
    pub scale: f64,
    /// What the truncation costs D_P.
    pub gain: f32,
}

impl Kernel {
    pub fn new(gaussian: GaussianFootprint, spacing: f64, intrinsic: f64) -> Self {
        let blur = (SEED_DEVIATION * spacing).powi(2);
        let variance = intrinsic * intrinsic;
        let reach = gaussian.reach(blur);
        let q = gaussian.covariance(blur);
        let t = f64::from(LARGEST_EXPONENT);
        let (inverse, whitening, weight, tail) = match reach {
            Reach::Local => {
                let peak = spacing * spacing / (TAU * q.determinant().sqrt());
                let sum = lattice_sum(&q, gaussian.center(), spacing);
                (q.inverse(), whitening(&q), peak / sum, (-t).exp() * (1.0 + t))
            }
            Reach::Whole => {
                let size = gaussian.map_size();
                let none = Symmetric {
                    xx: 0.0,
                    xy: 0.0,
                    yy: 0.0,
                };
                (none, [0.0; 3], spacing * spacing / (size.x * size.y), (-t).exp())
            }
        };
        let packed = |m: &Symmetric, factor: f64, diagonal: f64| {
            [diagonal + factor * m.xx, factor * m.xy, diagonal + factor * m.yy].map(|x| x as f32)
        };
        Self {
            whitening,
            blur: blur as f32,
            rest: packed(&inverse, -blur * blur, blur),
            variance: variance as f32,
            inv_variance: (1.0 / variance) as f32,
            max_distance2: (2.0 * t * variance) as f32,
            scale: weight / (TAU * variance),
            gain: (1.0 / (1.0 - tail)) as f32,
            gaussian,
            reach,
            q,
            spacing: spacing as f32,
        }
    }

    /// Sum of the shares of a leaf of flat elements; `corner` as in [`Self::offset`].
    #[inline]
    pub fn sum_flat(&self, s: Vec2, corner: Vec2, leaf: Leaf) -> f32 {
        let mut near = false;
        for (x, y) in leaf.x.iter().zip(leaf.y) {
            near |= (s.x - x) * (s.x - x) + (s.y - y) * (s.y - y) <= self.max_distance2;
        }
        if !near {
            return 0.0;
        }
        let mut sum = 0.0;
        for ((&x, &y), &place) in leaf.x.iter().zip(leaf.y).zip(leaf.places) {
            let delta = s - Vec2::new(x, y);
            let offset = self.offset(corner, place);
            let place = self.whitened(offset).length_squared();
            sum += share(0.5 * (place + delta.length_squared() * self.inv_variance));
        }
        sum
    }

    /// The same of curved elements. All exponents of a leaf are computed before any is used, so that they are
    /// computed side by side.
    #[inline]
    pub fn sum_curved(&self, s: Vec2, corner: Vec2, leaf: Leaf, jacobians: [&[f32]; 4]) -> f32 {
        let mut lobes = [(f32::INFINITY, 0.0); LEAF_SIZE];
        let count = leaf.x.len().min(LEAF_SIZE);
        let (x, y, places) = (&leaf.x[..count], &leaf.y[..count], &leaf.places[..count]);
        let jacobians = jacobians.map(|j| &j[..count]);
        for i in 0..count {
            let delta = s - Vec2::new(x[i], y[i]);
            let jacobian = jacobians.map(|j| j[i]);
            lobes[i] = self.exponent(self.offset(corner, places[i]), delta, &jacobian);
        }
        let mut sum = 0.0;
        for (exponent, height) in &lobes[..count] {
            sum += height * share(*exponent);
        }
        sum
    }

    /// Position of an element relative to the footprint's centre, in texels, from that of its block's corner
    /// and its place in the block.
    #[inline]
    fn offset(&self, corner: Vec2, place: u16) -> Vec2 {
        let (x, y) = (f32::from(place & 0xff), f32::from(place >> 8));
        corner + (Vec2::new(x, y) + 0.5) * self.spacing
    }

    /// `W d`.
    #[inline]
    fn whitened(&self, d: Vec2) -> Vec2 {
        let [wx, wxy, wy] = self.whitening;
        Vec2::new(wx * d.x + wxy * d.y, wy * d.y)
    }

    /// Exponent of the share of an element at `offset` from the centre, at a distance `delta` from its normal;
    /// and the height of its lobe relative to a flat one's.
    #[inline]
    pub fn exponent(&self, offset: Vec2, delta: Vec2, jacobian: &[f32; 4]) -> (f32, f32) {
        let [xu, xv, yu, yv] = *jacobian;
        let white = self.whitened(offset);
        let [wx, wxy, wy] = self.whitening;
        let pull = self.blur * Vec2::new(wx * white.x, wxy * white.x + wy * white.y);
        let d = delta + apply(jacobian, pull);
        let (x, y) = (Vec2::new(xu, xv), Vec2::new(yu, yv));
        let (rest_x, rest_y) = (multiply(&self.rest, x), multiply(&self.rest, y));
        let (xx, xy, yy) = (
            x.dot(rest_x) + self.variance,
            x.dot(rest_y),
            y.dot(rest_y) + self.variance,
        );
        let inv_determinant = 1.0 / (xx * yy - xy * xy);
        let distance = (yy * d.x * d.x - 2.0 * xy * d.x * d.y + xx * d.y * d.y) * inv_determinant;
        let exponent = 0.5 * (white.length_squared() + distance);
        (exponent, self.variance * inv_determinant.sqrt())
    }
}

/// `exp(-exponent)`, truncated.
#[inline]
fn share(exponent: f32) -> f32 {
    if exponent <= LARGEST_EXPONENT {
        (-exponent).exp()
    } else {
        0.0
    }
}

/// W of [`Kernel`]: along y, and along x what is left of the regression on y.
fn whitening(q: &Symmetric) -> [f32; 3] {
    let wx = (q.yy / q.determinant()).sqrt();
    [wx, -wx * q.xy / q.yy, 1.0 / q.yy.sqrt()].map(|x| x as f32)
}

#[inline]
fn multiply(m: &[f32; 3], v: Vec2) -> Vec2 {
    Vec2::new(m[0] * v.x + m[1] * v.y, m[1] * v.x + m[2] * v.y)
}

/// `J v`, for the Jacobian of an [`super::tree::Element`].
#[inline]
pub fn apply(jacobian: &[f32; 4], v: Vec2) -> Vec2 {
    Vec2::new(
        jacobian[0] * v.x + jacobian[1] * v.y,
        jacobian[2] * v.x + jacobian[3] * v.y,
    )
}

/// `sum_i H^2 N(u_i; c, Q)` over the infinite grid `u_i = (i + 1/2) H`, by Poisson's summation formula; the
/// terms left out are below 1e-6, as Q is at least `sigma_h^2 I`.
pub fn lattice_sum(q: &Symmetric, center: DVec2, spacing: f64) -> f64 {
    let wave = |k: DVec2| {
        let height = (-2.0 * PI * PI * q.form(k) / (spacing * spacing)).exp();
        2.0 * height * (TAU * k.dot(center / spacing - 0.5)).cos()
    };
    let waves = [DVec2::X, DVec2::Y, DVec2::ONE, DVec2::new(1.0, -1.0)];
    1.0 + waves.into_iter().map(wave).sum::<f64>()
}
