//! How far a method's distribution of normals is from the exact one.

use glam::Vec3;
use glints::footprint::Footprint;
use glints::methods::Method;
use glints::methods::direct::Direct;
use glints::methods::tensor::{Tensor, Uncompressed};

use crate::cost::{Cell, Random};

/// Relative L1 error of the distribution of normals, the integral of `|D - D_direct| cos` (that of `D_direct
/// cos` being one), averaged over footprints. `reach`: texels that the direct sum is over, for each of the cell.
pub fn of_distribution(method: &dyn Method, direct: &Direct, cell: &Cell, reach: f64) -> f64 {
    let [error] = mean(method, direct, (cell, reach), |footprint, h| {
        [method.ndf(footprint, h) - direct.ndf(footprint, h)]
    });
    error
}

/// The same of a tensor decomposition, and its parts: against the uncompressed images, and of these against the direct sum.
pub fn of_tensor(tensor: &Tensor, uncompressed: &Uncompressed, direct: &Direct, cell: &Cell) -> [f64; 3] {
    // As many points as under a box: the cells are few.
    mean(tensor, direct, (cell, 1.0), |footprint, h| {
        let (compressed, images) = (tensor.ndf(footprint, h), uncompressed.ndf(footprint, h));
        let exact = direct.ndf(footprint, h);
        [compressed - exact, compressed - images, images - exact]
    })
}

/// Integrals of the absolute values of `differences`, averaged over footprints. Half the points are drawn from each of the
/// two: what only one of them covers must count, too.
fn mean<const N: usize>(
    method: &dyn Method,
    direct: &Direct,
    (cell, reach): (&Cell, f64),
    differences: impl Fn(&Footprint, Vec3) -> [f32; N],
) -> [f64; N] {
    const FOOTPRINTS: usize = 16;
    /// Of the direct sum, for all points of a footprint: a single point that only one of the two covers counts as 2.
    const TEXELS: f64 = 1e6;
    let points = (TEXELS / (reach * cell.texels())).clamp(4.0, 256.0) as usize;
    let mut random = Random(11);
    let (mut sums, mut count) = ([0.0; N], 0_u32);
    for _ in 0..FOOTPRINTS {
        let footprint = cell.random_footprint(&mut random, method.map_size());
        for _ in 0..points {
            let u = std::array::from_fn(|_| random.uniform());
            let source: &dyn Method = if count % 2 == 0 { direct } else { method };
            count += 1;
            if let Some(h) = source.sample(&footprint, u) {
                let drawn_with = 0.5 * (method.density(&footprint, h) + direct.density(&footprint, h));
                for (sum, difference) in sums.iter_mut().zip(differences(&footprint, h)) {
                    *sum += f64::from(difference.abs() * h.z / drawn_with);
                }
            }
        }
    }
    sums.map(|sum| sum / f64::from(count))
}
