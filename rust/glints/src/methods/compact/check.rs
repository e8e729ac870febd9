//! What a query relies on: where the content of a file could lead it out of an array, into an endless loop or to an infinite
//! value, it is checked here, once, when the file is loaded.
//!
//! Not checked is what only makes answers wrong: a file with a right checksum was written as it is.

use rayon::prelude::*;

use super::blocks::{Block, Blocks, Geometry, SIDE_BITS};
use super::counts;
use super::grid::Grid;
use super::packing::WIDTHS;
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
    demand(tiles::lower_bits(cells).is_some(), || {
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

pub fn geometry(geometry: &Geometry) -> Checked<()> {
    let Geometry {
        side_bits, cell_bits, ..
    } = *geometry;
    let sizes = (SIDE_BITS[0]..=SIDE_BITS[1]).contains(&side_bits) && (1..=10).contains(&cell_bits);
    demand(sizes && WIDTHS.contains(&geometry.bits()), || {
        format!("blocks of 2^{side_bits} texels and cells of 2^{cell_bits}")
    })?;
    grid(&geometry.grid)
}

/// Rows of cells lie inside the grid, one behind the other; the number of their cells.
pub fn extents(geometry: &Geometry, extents: &[[u32; 3]]) -> Checked<usize> {
    let columns = geometry.grid.size[0].div_ceil(1 << geometry.cell_bits);
    let mut sum = 0_u32;
    for &[first, cells, before] in extents {
        let inside = first <= columns && cells <= columns - first;
        demand(inside && before == sum, || {
            "rows of cells outside the grid".into()
        })?;
        sum = sum.checked_add(cells).ok_or("more cells than fit 32 bits")?;
    }
    Ok(sum as usize)
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

/// Runs of cells, places and pointers stay inside their blocks.
pub fn blocks(blocks: &Blocks) -> Checked<()> {
    let geometry = blocks.geometry();
    (0..geometry.block_count()).into_par_iter().try_for_each(|index| {
        let block = geometry.block(index);
        runs(blocks, &block)?;
        permutation(blocks, &block)
    })
}

/// Rows of cells follow each other from zero to the block's number of texels, and so do the cells of a row.
fn runs(blocks: &Blocks, block: &Block) -> Checked<()> {
    let wrong = || "cells of a block do not follow each other".to_string();
    let rows = blocks.rows_of(block);
    let ends = rows[0] == 0 && rows[rows.len() - 1] as usize == block.texels();
    demand(ends, wrong)?;
    let base = blocks.cell_base(block);
    for (row, &[_, cells, before]) in rows.windows(2).zip(blocks.extents.iter()) {
        let texels = row[1].checked_sub(row[0]).ok_or_else(wrong)? as usize;
        let mut last = 0;
        for cell in before..before + cells {
            let offset = blocks.offsets.get(base + cell as usize);
            demand(last <= offset && offset <= texels, wrong)?;
            demand(cell > before || offset == 0, wrong)?;
            last = offset;
        }
        demand(cells > 0 || texels == 0, wrong)?;
    }
    Ok(())
}

/// Where words and pointers of a block lead to. A word of a block of full size has no room for more.
fn permutation(blocks: &Blocks, block: &Block) -> Checked<()> {
    let texels = block.texels();
    let place = |element| blocks.place(block, element) as usize;
    let places = texels == blocks.geometry().places() || (0..texels as u32).all(|e| place(e) < texels);
    let pointers = blocks.pointers_of(block).iter();
    demand(
        places
            && pointers
                .copied()
                .all(|to| (blocks.geometry().pointed(to) as usize) < texels),
        || "a texel lies outside its block".into(),
    )
}

pub fn demand(holds: bool, otherwise: impl FnOnce() -> String) -> Checked<()> {
    if holds { Ok(()) } else { Err(otherwise()) }
}
