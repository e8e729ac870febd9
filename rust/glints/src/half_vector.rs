//! Directions and half vectors in the local shading frame.

use glam::Vec3;

/// Two directions above the horizon and their half vector.
#[derive(Clone, Copy, Debug)]
pub struct DirectionPair {
    /// Towards the viewer.
    pub wi: Vec3,
    /// Towards the light.
    pub wo: Vec3,
    /// `(wi + wo) / |wi + wo|`; `half.z > 0`.
    pub half: Vec3,
    /// `wi . half = wo . half = |wi + wo| / 2 > 0`; the dot products cancel at grazing angles.
    pub cos: f32,
}

impl DirectionPair {
    /// `None` unless both unit vectors are above the horizon.
    #[inline]
    pub fn new(wi: Vec3, wo: Vec3) -> Option<Self> {
        let above = wi.z > 0.0 && wo.z > 0.0;
        let half = (wi + wo).try_normalize()?;
        let cos = 0.5 * (wi + wo).length();
        above.then_some(Self { wi, wo, half, cos })
    }

    /// The pair that reflects `wi` at the normal `half`, up to rounding; `None` if `wi` or the reflection is
    /// not above both horizons.
    #[inline]
    pub fn reflected(wi: Vec3, half: Vec3) -> Option<Self> {
        let cos = wi.dot(half);
        if cos <= 0.0 || wi.z <= 0.0 {
            return None;
        }
        let wo = (2.0 * cos * half - wi).normalize();
        Self::new(wi, wo)
    }
}
