//! The range of half vectors under a cone of light: the exact rectangle behind Eq. 9 of Deng et al. 2022.
//!
//! **Computes** the bounding rectangle, on the projected disk, of the half vectors of a fixed direction `i` and all
//! directions `o` of a cone `{ o : o . a >= cos theta }` above the horizon.
//!
//! **The set.** `o` is the reflection `2 (i . h) h - i` of `i` at `h`, so the cone's half vectors are those with
//!
//! ```text
//! h^T (i a^T + a i^T) h >= cos theta + i . a:
//! ```
//!
//! an elliptic cone. Its axis is the half vector of `i` and `a`; with `2 beta` the angle between those two, its
//! half angles are `theta / 2` in their plane and `atan sqrt((1 - cos theta) / (cos theta + cos 2 beta))`, about
//! `theta / (2 cos beta)`, across. The halved angle of Deng et al. ("we blur the NDF with a support of theta / 2")
//! is this fact at normal incidence: a half vector turns by half the angle of the light. Their side `Q = 256 theta /
//! pi` of the square also takes the disk's 256 pixels for pi radians, which are two units of sine: at the
//! disk's centre the exact side is `128 theta`, by pi / 2 larger, and at oblique incidence the rectangle is
//! longer across the plane of incidence, and shorter in the direction in which the disk is foreshortened.
//!
//! **The rectangle.** Along an axis `e` of the disk, `h . e` as a function of `o` has no critical point above the
//! horizon (only `h = +-e` are), so that its extremes lie on the boundary of the cut cone: on the cone's
//! circle where it is above the horizon, on the horizon's circle where it is inside the cone, or where the two
//! meet. On a circle `o(phi)`,
//!
//! ```text
//! h . e = N / sqrt(W),   N = e . (i + o(phi)),   W = |i + o(phi)|^2 = 2 + 2 i . o(phi),
//! ```
//!
//! both first-order in `cos phi`, `sin phi`; the critical points are the at most four roots of `N' W - N W' / 2`, of second
//! order. They are bracketed on a fixed grid of angles, two within one step by the extremum between them, and refined by
//! Newton's method, kept inside the bracket: where W is almost zero, opposite `i` at the horizon, a small step of the angle
//! changes `h` much.
//!
//! **Error** About 1e-6 of the rectangle's side.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3, Vec2, Vec3};

/// Steps of the grid on which critical points are bracketed.
const STEPS: usize = 24;

/// Newton steps for a root, at most.
const MOST_REFINEMENTS: usize = 40;

/// The smallest rectangle `(low, high)`, in half vectors' x and y, that holds the half vectors of `wi` and all
/// directions above the horizon within the angle with cosine `cos_angle` from `axis`; `None` if there are no such
/// directions, or `wi` is not above the horizon.
pub fn half_vector_rectangle(wi: Vec3, axis: Vec3, cos_angle: f32) -> Option<(Vec2, Vec2)> {
    let (wi, axis) = (wi.as_dvec3(), axis.as_dvec3());
    let (wi, axis) = (wi.try_normalize()?, axis.try_normalize()?);
    let cos_angle = f64::from(cos_angle).clamp(-1.0, 1.0);
    if wi.z <= 0.0 {
        return None;
    }
    let mut bounds = Bounds::EMPTY;
    let cone = Circle::new(axis, cos_angle);
    let horizon = Circle::new(DVec3::Z, 0.0);
    if cos_angle > -1.0 {
        for o in cone.critical_points(wi).filter(|o| o.z >= 0.0) {
            bounds.add(wi, o);
        }
        for o in meeting_points(axis, cos_angle) {
            bounds.add(wi, o);
        }
    }
    for o in horizon.critical_points(wi).filter(|o| o.dot(axis) >= cos_angle) {
        bounds.add(wi, o);
    }
    bounds.rectangle()
}

struct Bounds {
    low: DVec2,
    high: DVec2,
}

impl Bounds {
    const EMPTY: Self = Self {
        low: DVec2::INFINITY,
        high: DVec2::NEG_INFINITY,
    };

    fn add(&mut self, wi: DVec3, wo: DVec3) {
        let h = (wi + wo).normalize_or_zero().truncate();
        self.low = self.low.min(h);
        self.high = self.high.max(h);
    }

    fn rectangle(&self) -> Option<(Vec2, Vec2)> {
        let is_empty = !self.low.cmple(self.high).all();
        (!is_empty).then(|| (self.low.as_vec2(), self.high.as_vec2()))
    }
}

/// The directions at a fixed angle from an axis: `center + u cos phi + v sin phi`.
struct Circle {
    center: DVec3,
    u: DVec3,
    v: DVec3,
}

impl Circle {
    fn new(axis: DVec3, cos: f64) -> Self {
        // 1 - cos^2 without cancellation.
        let sin = ((1.0 - cos) * (1.0 + cos)).max(0.0).sqrt();
        let (u, v) = axis.any_orthonormal_pair();
        Self {
            center: axis * cos,
            u: u * sin,
            v: v * sin,
        }
    }

    /// The directions of the circle at which x or y of the half vector with `wi` is extremal.
    fn critical_points(&self, wi: DVec3) -> impl Iterator<Item = DVec3> {
        let norm = Wave {
            mean: 2.0 + 2.0 * wi.dot(self.center),
            cos: 2.0 * wi.dot(self.u),
            sin: 2.0 * wi.dot(self.v),
        };
        let along = |e: DVec3| Wave {
            mean: e.dot(wi + self.center),
            cos: e.dot(self.u),
            sin: e.dot(self.v),
        };
        let slopes = [along(DVec3::X), along(DVec3::Y)].map(|n| Slope { n, w: norm });
        slopes
            .into_iter()
            .flat_map(Slope::roots)
            .map(|(cos, sin)| self.center + self.u * cos + self.v * sin)
    }
}

/// `mean + cos cos(phi) + sin sin(phi)`.
#[derive(Clone, Copy)]
struct Wave {
    mean: f64,
    cos: f64,
    sin: f64,
}

impl Wave {
    fn value(&self, (cos, sin): (f64, f64)) -> f64 {
        self.mean + self.cos * cos + self.sin * sin
    }

    /// The first derivative; the second is `mean - value`.
    fn derivative(&self, (cos, sin): (f64, f64)) -> f64 {
        self.sin * cos - self.cos * sin
    }
}

/// `N' W - N W' / 2`, with the zeros of the derivative of `N / sqrt(W)`.
#[derive(Clone, Copy)]
struct Slope {
    n: Wave,
    w: Wave,
}

impl Slope {
    fn value(&self, p: (f64, f64)) -> f64 {
        self.n.derivative(p) * self.w.value(p) - 0.5 * self.n.value(p) * self.w.derivative(p)
    }

    fn derivative(&self, p: (f64, f64)) -> f64 {
        (self.n.mean - self.n.value(p)) * self.w.value(p) + 0.5 * self.n.derivative(p) * self.w.derivative(p)
            - 0.5 * self.n.value(p) * (self.w.mean - self.w.value(p))
    }

    /// Cosines and sines of the roots.
    fn roots(self) -> impl Iterator<Item = (f64, f64)> {
        let nodes: [_; STEPS + 1] = std::array::from_fn(|step| {
            let phi = TAU * step as f64 / STEPS as f64;
            let p = cos_sin(phi);
            (phi, self.value(p), self.derivative(p))
        });
        (0..STEPS)
            .flat_map(move |step| self.brackets(nodes[step], nodes[step + 1]))
            .flatten()
            .map(move |(a, b)| self.root(a, b))
    }

    /// The intervals with one root each between two angles, given with value and derivative there.
    fn brackets(&self, a: (f64, f64, f64), b: (f64, f64, f64)) -> [Option<(f64, f64)>; 2] {
        let changes = |one: f64, other: f64| (one < 0.0) != (other < 0.0);
        if changes(a.1, b.1) {
            return [Some((a.0, b.0)), None];
        }
        // The value goes towards zero and comes back.
        if a.1 * a.2 < 0.0 && b.1 * b.2 > 0.0 {
            let middle = a.0 + (b.0 - a.0) * a.2 / (a.2 - b.2);
            if changes(a.1, self.value(cos_sin(middle))) {
                return [Some((a.0, middle)), Some((middle, b.0))];
            }
        }
        [None, None]
    }

    /// The root between two angles at which signs differ: Newton's method, or bisection where it leaves the bracket.
    fn root(&self, mut a: f64, mut b: f64) -> (f64, f64) {
        let is_negative = self.value(cos_sin(a)) < 0.0;
        let mut phi = 0.5 * (a + b);
        for _ in 0..MOST_REFINEMENTS {
            let p = cos_sin(phi);
            let value = self.value(p);
            if (value < 0.0) == is_negative {
                a = phi;
            } else {
                b = phi;
            }
            let newton = phi - value / self.derivative(p);
            let next = if a < newton && newton < b {
                newton
            } else {
                0.5 * (a + b)
            };
            let step = (next - phi).abs();
            phi = next;
            if step < 1e-9 {
                break;
            }
        }
        cos_sin(phi)
    }
}

fn cos_sin(phi: f64) -> (f64, f64) {
    let (sin, cos) = phi.sin_cos();
    (cos, sin)
}

/// Where the circle about `axis` meets the horizon.
fn meeting_points(axis: DVec3, cos_angle: f64) -> impl Iterator<Item = DVec3> {
    let flat = axis.truncate();
    let cos = cos_angle / flat.length();
    let points = (cos.abs() <= 1.0).then(|| {
        let along = flat.normalize() * cos;
        let across = flat.normalize().perp() * ((1.0 - cos) * (1.0 + cos)).max(0.0).sqrt();
        [along + across, along - across].map(|p| p.extend(0.0))
    });
    points.into_iter().flatten()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn direction(z: f32, phi: f32) -> Vec3 {
        let sin = (1.0 - z * z).sqrt();
        Vec3::new(sin * phi.cos(), sin * phi.sin(), z)
    }

    /// Half vectors of the cone: rings of directions from the rim inwards, those above the horizon.
    fn half_vectors(wi: Vec3, axis: Vec3, cos_angle: f32) -> impl Iterator<Item = Vec2> {
        let (u, v) = axis.as_dvec3().any_orthonormal_pair();
        let (wi, axis, cos_angle) = (wi.as_dvec3(), axis.as_dvec3(), f64::from(cos_angle));
        const RINGS: usize = 60;
        const SPOKES: usize = 1200;
        (0..=RINGS * SPOKES).filter_map(move |i| {
            let cos = cos_angle + (1.0 - cos_angle) * ((i / SPOKES) as f64 / RINGS as f64);
            let sin = ((1.0 - cos) * (1.0 + cos)).max(0.0).sqrt();
            let phi = TAU * (i % SPOKES) as f64 / SPOKES as f64;
            let o = axis * cos + (u * phi.cos() + v * phi.sin()) * sin;
            (o.z >= 0.0).then(|| (wi + o).normalize().truncate().as_vec2())
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        /// No half vector is outside by more than rounding, and some half vector comes near every side: the spacing
        /// of the directions tried is 1/60 of the cone on the horizon, and finer elsewhere.
        #[test]
        fn the_rectangle_holds_all_half_vectors_and_is_tight(
            zi in 0.05..1.0_f32, pi in 0.0..6.3_f32, za in -0.6..1.0_f32, pa in 0.0..6.3_f32, angle in 0.005..1.8_f32,
        ) {
            let (wi, axis, cos) = (direction(zi, pi), direction(za, pa), angle.cos());
            let mut bounds = (Vec2::INFINITY, Vec2::NEG_INFINITY);
            for h in half_vectors(wi, axis, cos) {
                bounds = (bounds.0.min(h), bounds.1.max(h));
            }
            let Some((low, high)) = half_vector_rectangle(wi, axis, cos) else {
                prop_assert!(bounds.0.x > bounds.1.x);
                return Ok(());
            };
            // Nothing of a sliver above the horizon may have been tried.
            prop_assume!(bounds.0.x <= bounds.1.x);
            let slack = 3e-6 + 1e-4 * (high - low).max_element();
            prop_assert!(bounds.0.cmpge(low - slack).all() && bounds.1.cmple(high + slack).all(),
                "{bounds:?} is not in {low} to {high}");
            let gap = 3e-6 + 0.05 * angle;
            prop_assert!(bounds.0.cmple(low + gap).all() && bounds.1.cmpge(high - gap).all(),
                "{bounds:?} leaves gaps to {low}, {high}");
            // Away from the horizon the directions tried are dense on the boundary.
            if axis.z > angle.sin() + 0.02 && angle < 1.5 {
                let gap = 3e-6 + 1e-4 * (high - low).max_element();
                prop_assert!(bounds.0.cmple(low + gap).all() && bounds.1.cmpge(high - gap).all(),
                    "{bounds:?} leaves gaps to {low}, {high}");
            }
        }
    }

    /// Light from below the horizon, opposite a grazing viewer: W is almost zero, and two critical points are close.
    #[test]
    fn light_opposite_a_grazing_viewer_is_held() {
        let (wi, axis) = (
            direction(0.05, 1.150_936_8),
            direction(-0.396_682_68, 3.600_449_6),
        );
        let cos = 0.712_961_26_f32.cos();
        let (low, high) = half_vector_rectangle(wi, axis, cos).unwrap();
        for h in half_vectors(wi, axis, cos) {
            assert!(
                h.cmpge(low - 1e-4).all() && h.cmple(high + 1e-4).all(),
                "{h} is not in {low} to {high}"
            );
        }
    }

    #[test]
    fn a_small_cone_at_normal_incidence_is_a_square_of_its_angle() {
        let angle = 0.02_f32;
        let (low, high) = half_vector_rectangle(Vec3::Z, Vec3::Z, angle.cos()).unwrap();
        for side in (high - low).to_array() {
            assert!((side / angle - 1.0).abs() < 1e-3, "{side}");
        }
        // The paper's Q = 256 theta / pi pixels of a disk 256 pixels wide are 2 / pi of that.
        assert!((256.0 * angle / std::f32::consts::PI) * (2.0 / 256.0) < 0.65 * (high.x - low.x));
    }

    #[test]
    fn oblique_incidence_stretches_it_across_the_plane_of_incidence() {
        let (angle, beta) = (0.01_f32, 1.0_f32);
        let wi = Vec3::new(beta.sin(), 0.0, beta.cos());
        let axis = Vec3::new(-wi.x, 0.0, wi.z);
        let (low, high) = half_vector_rectangle(wi, axis, angle.cos()).unwrap();
        assert!(((high.x - low.x) / angle - 1.0).abs() < 1e-2);
        assert!(((high.y - low.y) / (angle / beta.cos()) - 1.0).abs() < 1e-2);
    }

    #[test]
    fn nothing_above_the_horizon_has_no_rectangle() {
        assert!(half_vector_rectangle(Vec3::Z, -Vec3::Z, 0.5).is_none());
        assert!(half_vector_rectangle(-Vec3::Z, Vec3::Z, 0.5).is_none());
        assert!(half_vector_rectangle(Vec3::Z, Vec3::splat(f32::NAN), 0.5).is_none());
        let (low, high) = half_vector_rectangle(Vec3::Z, -Vec3::Z, -1.0).unwrap();
        // All directions: the half vectors of the viewer above fill the disk of radius sin 45 degrees.
        let radius = std::f32::consts::FRAC_1_SQRT_2;
        assert!((low + radius).abs().max_element() < 1e-5 && (high - radius).abs().max_element() < 1e-5);
    }
}
