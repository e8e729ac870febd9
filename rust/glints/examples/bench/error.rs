//! How far a method's distribution of normals is from the exact one.

use glints::methods::Method;
use glints::methods::direct::Direct;

use crate::cost::{Cell, Random};

/// Relative L1 error of the distribution of normals, the integral of `|D - D_direct| cos` (that of `D_direct
/// cos` being one), averaged over footprints. Half the points are drawn from each of the two: what only one
/// of them covers must count, too.
pub fn of_distribution(method: &dyn Method, direct: &Direct, cell: &Cell) -> f64 {
    const FOOTPRINTS: usize = 16;
    /// Of the direct sum, for all points of a footprint: a single point that only one of the two covers counts as 2.
    const TEXELS: f64 = 1e6;
    let points = (TEXELS / cell.texels()).clamp(4.0, 256.0) as usize;
    let mut random = Random(11);
    let (mut sum, mut count) = (0.0, 0);
    for _ in 0..FOOTPRINTS {
        let footprint = cell.random_footprint(&mut random, method.map_size());
        for _ in 0..points {
            let u = std::array::from_fn(|_| random.uniform());
            let source: &dyn Method = if count % 2 == 0 { direct } else { method };
            count += 1;
            if let Some(h) = source.sample(&footprint, u) {
                let drawn_with = 0.5 * (method.density(&footprint, h) + direct.density(&footprint, h));
                let difference = (method.ndf(&footprint, h) - direct.ndf(&footprint, h)).abs();
                sum += f64::from(difference * h.z / drawn_with);
            }
        }
    }
    sum / count as f64
}
