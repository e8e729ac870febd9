//! What a query relies on: where the content of a file could lead it out of an array, into an endless loop or to an infinite
//! value, it is checked here, once, when the file is loaded.
//!
//! Not checked is what only makes answers wrong: a file with a right checksum was written as it is.

use super::counts;
use super::grid::Grid;
use super::strays::Strays;
use super::tiles;
use crate::normal_map::MAX_SIDE;

/// What is wrong.
type Checked<T> = std::result::Result<T, String>;

/// Most cells of a grid along an axis: single precision counts them exactly.
const MAX_CELLS: u32 = 1 << 24;

pub fn map_size((width, height): (u32, u32)) -> Checked<()> {
    let fits = |side: u32| (1..=MAX_SIDE).contains(&side);
    demand(fits(width) && fits(height), || {
        format!("a map of {width} x {height} texels")
    })
}

/// A grid is finite and not much larger than the disk.
fn grid(grid: &Grid) -> Checked<()> {
    let sides = [0, 1].map(|axis| {
        let low = f64::from(grid.low[axis]);
        let high = low + f64::from(grid.pitch) * f64::from(grid.size[axis]);
        (1..=MAX_CELLS).contains(&grid.size[axis]) && low >= -2.0 && high <= 4.0
    });
    // The finest grid has a pitch of a hundredth of the least roughness.
    demand(sides == [true; 2] && (1e-7..=2.0).contains(&grid.pitch), || {
        format!("a grid of {:?} cells", grid.size)
    })
}

/// A grid of [`tiles`].
pub fn tile_grid(cells: &Grid) -> Checked<()> {
    grid(cells)?;
    demand(tiles::has_layout(cells), || {
        format!("{:?} cells take more than 32 bits", cells.size)
    })
}

/// The bins of counts for flakes of roughness `alpha`.
pub fn bins(bins: &Grid, alpha: f32) -> Checked<()> {
    grid(bins)?;
    demand(counts::is_width(bins.pitch, alpha), || {
        format!("bins of width {}", bins.pitch)
    })
}

/// Squares of strays follow each other, and strays are texels of the map.
pub fn strays(strays: &Strays, (width, height): (u32, u32)) -> Checked<()> {
    let [side, columns, rows] = strays.squares;
    let squares = u64::from(columns) * u64::from(rows);
    let offsets = &strays.offsets;
    let sizes = side > 0 && squares > 0 && offsets.len() as u64 == squares + 1;
    demand(sizes, || format!("{columns} x {rows} squares of strays"))?;
    let ends = offsets[0] == 0 && offsets[offsets.len() - 1] as usize == strays.strays.len();
    demand(ends && offsets.is_sorted(), || {
        "squares of strays do not follow each other".into()
    })?;
    let texels = u64::from(width) * u64::from(height);
    let inside = strays.strays.iter().all(|stray| u64::from(stray[2]) < texels);
    demand(inside, || "a stray outside the map".into())
}

pub fn demand(holds: bool, otherwise: impl FnOnce() -> String) -> Checked<()> {
    if holds { Ok(()) } else { Err(otherwise()) }
}
