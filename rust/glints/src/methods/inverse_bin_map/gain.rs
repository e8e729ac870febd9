//! What the truncation to 21 bins takes from a flake's lobe, and the factor that puts it back.

use glam::{DVec2, DVec3, Vec3};

use super::bins::{self, BinGrid};
use crate::microfacet::{Distribution, Flake};

/// `g_j = 1 / mass_j`, with `mass_j` the mass of the flake's lobe about `b_j` inside the 21 bins around bin j,
/// relative to its mass above the horizon.
///
/// The mass depends on the tilt of `b_j`, because projection onto the disk narrows the lobe radially by `cos
/// theta`, and hardly on its azimuth, so it is a table over the radius, averaged over azimuths. Beckmann's mass
/// grows from 0.9898 at the pole (three standard deviations either way, without corners) to 1, and the table
/// is accurate to about 1e-3. GGX's grows from 0.83 to 0.9, accurate to 5e-3.
pub struct LobeGain {
    by_radius: Vec<f32>,
}

impl LobeGain {
    const INTERVALS: usize = 32;

    pub fn new(grid: BinGrid, flake: Flake) -> Self {
        let mass = match flake.kind() {
            Distribution::Beckmann => beckmann_mass,
            Distribution::Ggx => ggx_mass,
        };
        let azimuths = [0.0, 0.125, 0.25].map(|turn: f64| turn * std::f64::consts::FRAC_PI_2 * 2.0);
        let by_radius = (0..=Self::INTERVALS)
            .map(|i| {
                let radius = i as f64 / Self::INTERVALS as f64;
                let masses = azimuths.map(|phi| mass(grid.width(), flake.alpha().into(), radius, phi));
                (azimuths.len() as f64 / masses.iter().sum::<f64>()) as f32
            })
            .collect();
        Self { by_radius }
    }

    #[inline]
    pub fn at(&self, normal: Vec3) -> f32 {
        let x = normal.truncate().length().min(1.0) * Self::INTERVALS as f32;
        let i = (x as usize).min(Self::INTERVALS - 1);
        let f = x - i as f32;
        self.by_radius[i] * (1.0 - f) + self.by_radius[i + 1] * f
    }

    pub fn bytes(&self) -> usize {
        size_of_val(self.by_radius.as_slice())
    }
}

/// Mass of a Beckmann lobe inside the 21 bins of side `bin_width` around its own, for a lobe tilted to `radius` on the
/// disk, `azimuth` from the grid's x axis: `D^alpha cos` over offsets on the disk, whose radial part is
/// stretched by `1 / cos theta` into the lobe's own tangent plane (first order in the offset; the horizon is
/// ignored, as it cuts the exact lobe alike).
fn beckmann_mass(bin_width: f64, alpha: f64, radius: f64, azimuth: f64) -> f64 {
    // Gauss-Legendre nodes and weights on [-1/2, 1/2]; a bin is 1.2 standard deviations wide.
    const RULE: [(f64, f64); 4] = [
        (-0.430_568_155_797_026, 0.173_927_422_568_727),
        (-0.169_990_521_792_428, 0.326_072_577_431_273),
        (0.169_990_521_792_428, 0.326_072_577_431_273),
        (0.430_568_155_797_026, 0.173_927_422_568_727),
    ];
    // Wider bins hold the whole lobe, and a tilt beyond 70 degrees changes nothing any more; the rule
    // resolves neither.
    let bin_width = bin_width.min(1.5 * alpha);
    let cos_tilt = (1.0 - radius * radius).max(0.12).sqrt();
    let (sin_phi, cos_phi) = azimuth.sin_cos();
    let density = |x: f64, y: f64| {
        let radial = (x * cos_phi + y * sin_phi) / cos_tilt;
        let tangential = y * cos_phi - x * sin_phi;
        let sin2 = radial * radial + tangential * tangential;
        if sin2 >= 1.0 {
            return 0.0;
        }
        let cos2 = 1.0 - sin2;
        (-sin2 / cos2 / (alpha * alpha)).exp() / (std::f64::consts::PI * (alpha * cos2).powi(2) * cos_tilt)
    };
    let mut mass = 0.0;
    for (dx, dy) in bins::offsets() {
        for (x, wx) in RULE {
            for (y, wy) in RULE {
                let position = |d: i32, node: f64| (f64::from(d) + node) * bin_width;
                mass += wx * wy * density(position(dx, x), position(dy, y));
            }
        }
    }
    mass * bin_width * bin_width
}

/// Share of a GGX lobe's mass above the horizon that is inside the 21 bins of side `bin_width` around its
/// normal, for a lobe tilted to `radius` on the disk, `azimuth` from the grid's x axis.
///
/// Stretching the tangential components of h by `1 / alpha` turns `D^alpha(h, t) (h . t) dh` into the cosine
/// over pi: the lobe over a polygon of directions is Lambert's formula for the stretched polygon, a sum over its
/// edges. The sides of bins are lines on the disk and hardly bent on the sphere; halves of them are taken as
/// straight. Points outside the disk are moved to its rim. Quadrature would need many points: a tilted lobe is
/// narrower than a bin.
fn ggx_mass(bin_width: f64, alpha: f64, radius: f64, azimuth: f64) -> f64 {
    let on_disk = DVec2::from_angle(azimuth) * radius;
    let normal = on_disk.extend((1.0 - radius * radius).sqrt());
    let (x, y) = normal.any_orthonormal_pair();
    let corners: Vec<DVec3> = outline()
        .map(|offset| {
            let p = (on_disk + offset * bin_width).clamp_length_max(1.0);
            let h = p.extend((1.0 - p.length_squared()).max(0.0).sqrt());
            DVec3::new(h.dot(x) / alpha, h.dot(y) / alpha, h.dot(normal).max(1e-9)).normalize()
        })
        .collect();
    let next = corners.iter().cycle().skip(1);
    let mass: f64 = corners.iter().zip(next).map(|(&a, &b)| edge_term(a, b)).sum();
    // The flake's slopes along the tilt are distributed as (1 + s / sqrt(alpha^2 + s^2)) / 2.
    let cotangent = normal.z / radius.max(1e-9);
    let above = 0.5 * (1.0 + cotangent / cotangent.hypot(alpha));
    mass.abs() / std::f64::consts::TAU / above
}

/// Lambert's term of the edge from `a` to `b`, the angle between them times the z of their unit normal.
fn edge_term(a: DVec3, b: DVec3) -> f64 {
    let cross = a.cross(b);
    let sin = cross.length();
    if sin < 1e-15 {
        return 0.0;
    }
    sin.atan2(a.dot(b)) * cross.z / sin
}

/// The border of the 21 bins in steps of half a bin, counterclockwise, in bins from the centre.
fn outline() -> impl Iterator<Item = DVec2> {
    const CORNERS: [(f64, f64); 13] = [
        (-1.5, -2.5),
        (1.5, -2.5),
        (1.5, -1.5),
        (2.5, -1.5),
        (2.5, 1.5),
        (1.5, 1.5),
        (1.5, 2.5),
        (-1.5, 2.5),
        (-1.5, 1.5),
        (-2.5, 1.5),
        (-2.5, -1.5),
        (-1.5, -1.5),
        (-1.5, -2.5),
    ];
    CORNERS.windows(2).flat_map(|pair| {
        let [from, to] = [pair[0], pair[1]].map(DVec2::from);
        let steps = (2.0 * (to - from).length()) as u32;
        (0..steps).map(move |step| from.lerp(to, f64::from(step) / f64::from(steps)))
    })
}
