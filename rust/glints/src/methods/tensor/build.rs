//! From a map to compressed images: block by block, and within blocks group by group.

use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;
use wide::f64x4;

use super::cp::{self, Tensor};
use super::images::{Group, Images, Members, PADDING, Parts};
use super::lobe::Lobes;
use super::pyramid::{Geometry, Pyramid};
use super::quantise::{Quantised, quantise};
use super::{BLOCK, Options, PIXELS};
use crate::normal_map::NormalMap;

/// What the precomputation tells about itself.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// Levels computed, and kept after neighbours agreed.
    pub levels: (usize, usize),
    /// Mean relative L1 difference of each level from the next, before compression.
    pub agreement: Vec<f64>,
    /// Groups of blocks, and blocks that are not blank.
    pub groups: usize,
    pub blocks: usize,
    /// Root of the sum of squared errors of all blocks over that of their values, of the decompositions before quantisation.
    pub relative_error: f64,
    /// Of each level's images, before they are normalised: mean relative L1 error, and mean squared error of a pixel, of what
    /// counts of the quantised decompositions against the images before compression, blank blocks included.
    pub errors: Vec<(f64, f64)>,
    /// Iterations of the solver, of all groups.
    pub iterations: u64,
    /// Thread seconds in the pyramid and in the decompositions.
    pub pyramid_seconds: f64,
    pub solver_seconds: f64,
}

/// One group, decomposed and quantised.
struct Compressed {
    region: u8,
    block: u16,
    /// Images that have a row.
    images: Vec<u32>,
    vectors: Quantised,
    squared_error: f64,
    square: f64,
    iterations: u64,
    /// Sums over the pixels of each level of absolute and of squared errors.
    errors: Vec<(f64, f64)>,
}

/// `progress` is called with the share of the work that is done, from any thread.
pub fn build(
    map: &NormalMap,
    lobes: Lobes,
    options: &Options,
    progress: &(dyn Fn(f64) + Sync),
) -> (Images, Report) {
    let geometry = Geometry::new((map.width(), map.height()), options.resolution, options.stride);
    let members = Members::new(&geometry);
    let pyramid = Pyramid::new(map, &geometry, lobes);
    let (shares, blocks) = work(map, &geometry, lobes);
    let done = AtomicU64::new(0);
    let advance = |share: f64| {
        let done = done.fetch_add((share * 1e9) as u64, Ordering::Relaxed) as f64 / 1e9;
        progress((done + share).min(1.0));
    };
    let nanoseconds = [AtomicU64::new(0), AtomicU64::new(0)];
    let timed = |which: usize, start: std::time::Instant| {
        nanoseconds[which].fetch_add(start.elapsed().as_nanos() as u64, Ordering::Relaxed);
    };

    let mut groups = Vec::new();
    let mut lost = vec![(0.0, 0.0); geometry.levels.len()];
    let mut differences = vec![0.0; geometry.levels.len() - 1];
    // As many blocks at a time as there are threads: their memory is what the precomputation needs.
    for chunk in blocks.chunks(rayon::current_num_threads()) {
        let images: Vec<_> = chunk
            .par_iter()
            .map(|&block| {
                let start = std::time::Instant::now();
                let images = pyramid.block(block);
                let differences = images
                    .as_deref()
                    .map(|images| level_differences(&geometry, images));
                timed(0, start);
                advance(0.3 * shares[block as usize]);
                (block, images, differences)
            })
            .collect();
        for (sum, difference) in images
            .iter()
            .filter_map(|(.., differences)| differences.as_ref())
            .flat_map(|differences| differences.iter().enumerate())
            .map(|(level, difference)| (level, *difference))
        {
            differences[sum] += difference;
        }
        let tasks: Vec<(u32, &[f32], u8)> = images
            .iter()
            .filter_map(|(block, images, _)| Some((*block, images.as_deref()?)))
            .flat_map(|(block, images)| {
                (0..members.images.len()).map(move |region| (block, images, region as u8))
            })
            .collect();
        let compressed: Vec<_> = tasks
            .into_par_iter()
            .map(|(block, images, region)| {
                let start = std::time::Instant::now();
                let group = compress(&members, images, block, region, &geometry, options);
                timed(1, start);
                advance(0.7 * shares[block as usize] / members.images.len() as f64);
                group
            })
            .collect();
        for (blank, group) in compressed {
            add_errors(&mut lost, &blank);
            groups.extend(group);
        }
    }

    let pixel = f64::from(geometry.pixel());
    let agreement: Vec<f64> = differences.iter().map(|d| d * pixel * pixel).collect();
    let kept = agreement
        .iter()
        .position(|&d| d < f64::from(options.agreement))
        .map_or(geometry.levels.len(), |level| level + 1);
    let square: f64 = groups.iter().map(|g| g.square).sum();
    let error: f64 = groups.iter().map(|g| g.squared_error).sum();
    let report = Report {
        levels: (geometry.levels.len(), kept),
        agreement,
        groups: groups.len(),
        blocks: groups.iter().map(|g| g.images.len()).sum(),
        relative_error: (error / square.max(f64::MIN_POSITIVE)).sqrt(),
        errors: mean_errors(&geometry, &groups, &lost),
        iterations: groups.iter().map(|g| g.iterations).sum(),
        pyramid_seconds: nanoseconds[0].load(Ordering::Relaxed) as f64 / 1e9,
        solver_seconds: nanoseconds[1].load(Ordering::Relaxed) as f64 / 1e9,
    };
    groups.sort_by_key(|group| (group.region, group.block));
    let images = assemble(geometry.coarsened(kept), groups);
    progress(1.0);
    (images, report)
}

/// Blocks that a lobe may touch, and the share of the work that each is: of the normals in it, weighted little, and equal
/// parts.
fn work(map: &NormalMap, geometry: &Geometry, lobes: Lobes) -> (Vec<f64>, Vec<u32>) {
    let side = geometry.blocks();
    let mut touched = vec![false; (side * side) as usize];
    let extent = geometry.pixel() * BLOCK as f32;
    let reach = lobes.reach() + geometry.pixel();
    let cell = |x: f32| (((x + 1.0) / extent) as i32).clamp(0, side as i32 - 1) as u32;
    for t in map.normals() {
        for row in cell(t.y - reach)..=cell(t.y + reach) {
            for column in cell(t.x - reach)..=cell(t.x + reach) {
                touched[(row * side + column) as usize] = true;
            }
        }
    }
    let blocks: Vec<u32> = (0..side * side).filter(|&b| touched[b as usize]).collect();
    let share = 1.0 / blocks.len().max(1) as f64;
    (
        touched.iter().map(|&t| if t { share } else { 0.0 }).collect(),
        blocks,
    )
}

/// Sum of the absolute differences of each level from the next one, interpolated, a mean over its nodes.
fn level_differences(geometry: &Geometry, images: &[f32]) -> Vec<f64> {
    let pixels = |image: u32| &images[image as usize * PIXELS..][..PIXELS];
    geometry
        .levels
        .windows(2)
        .map(|pair| {
            let (fine, coarse) = (&pair[0], &pair[1]);
            let [x, y] = fine.axes;
            let mut sum = 0.0;
            for row in 0..y.kept {
                for column in 0..x.kept {
                    let near = |node: u32, axis: usize| {
                        let position = f64::from(node) * fine.axes[axis].spacing();
                        let nodes = coarse.axes[axis].neighbours(f64x4::splat(position));
                        nodes.map(|(nodes, weights)| (nodes[0], weights[0]))
                    };
                    let mut expected = [0.0; PIXELS];
                    for (r, wy) in near(row, 1) {
                        for (c, wx) in near(column, 0) {
                            let weight = (wx * wy) as f32;
                            if weight > 0.0 {
                                let image = pixels(coarse.image(c, r));
                                expected.iter_mut().zip(image).for_each(|(e, v)| *e += weight * v);
                            }
                        }
                    }
                    let image = pixels(fine.image(column, row));
                    sum += image
                        .iter()
                        .zip(&expected)
                        .map(|(a, b)| f64::from((a - b).abs()))
                        .sum::<f64>();
                }
            }
            sum / f64::from(x.kept * y.kept)
        })
        .collect()
}

type Errors = Vec<(f64, f64)>;

fn add_errors(sums: &mut Errors, errors: &Errors) {
    for (sum, error) in sums.iter_mut().zip(errors) {
        sum.0 += error.0;
        sum.1 += error.1;
    }
}

/// Means over images and pixels.
fn mean_errors(geometry: &Geometry, groups: &[Compressed], lost: &Errors) -> Errors {
    let mut sums = lost.clone();
    for group in groups {
        add_errors(&mut sums, &group.errors);
    }
    let pixels = f64::from(geometry.resolution).powi(2);
    let area = f64::from(geometry.pixel()).powi(2);
    sums.iter()
        .zip(&geometry.levels)
        .map(|((absolute, squared), level)| {
            let images = f64::from(level.images());
            (absolute * area / images, squared / (pixels * images))
        })
        .collect()
}

/// Errors of approximations of blocks, by level.
fn errors<'a>(geometry: &Geometry, blocks: impl Iterator<Item = (u32, &'a [f32], &'a [f32])>) -> Errors {
    let mut sums = vec![(0.0, 0.0); geometry.levels.len()];
    for (image, expected, found) in blocks {
        let level = geometry.levels.partition_point(|level| level.first <= image) - 1;
        for (expected, found) in expected.iter().zip(found) {
            let error = f64::from((expected - found).abs());
            sums[level].0 += error;
            sums[level].1 += error * error;
        }
    }
    sums
}

/// The group of a region: its blocks that are not blank, decomposed; and the errors of leaving out the blank ones.
fn compress(
    members: &Members,
    images: &[f32],
    block: u32,
    region: u8,
    geometry: &Geometry,
    options: &Options,
) -> (Errors, Option<Compressed>) {
    let blank = options.blank / (geometry.pixel() * geometry.pixel());
    let (present, left_out): (Vec<_>, Vec<_>) = members.images[region as usize]
        .iter()
        .map(|&image| (image, &images[image as usize * PIXELS..][..PIXELS]))
        .partition(|(_, pixels)| pixels.iter().sum::<f32>() > blank);
    let nothing = [0.0; PIXELS];
    let lost = errors(geometry, left_out.into_iter().map(|(i, p)| (i, p, &nothing[..])));
    if present.is_empty() {
        return (lost, None);
    }
    let values: Vec<f32> = present
        .iter()
        .flat_map(|(_, pixels)| pixels.iter().copied())
        .collect();
    let square: f64 = values.iter().map(|&v| f64::from(v).powi(2)).sum();
    let tensor = Tensor {
        dims: [BLOCK, BLOCK, present.len()],
        values: &values,
    };
    let result = match options.ranks()[..] {
        [rank] => cp::decompose(
            &tensor,
            &cp::Options {
                rank,
                ..options.solver.clone()
            },
        ),
        ref ranks => cp::decompose_to(&tensor, ranks, options.error.into(), &options.solver),
    };
    let vectors = quantise(&result.factors, result.rank, &values, options.solver.ridge);
    let found = vectors.reconstructed();
    let errors = errors(
        geometry,
        present
            .iter()
            .zip(found.chunks_exact(PIXELS))
            .map(|((image, pixels), found)| (*image, *pixels, found)),
    );
    let group = Compressed {
        region,
        block: block as u16,
        images: present.iter().map(|&(image, _)| image).collect(),
        vectors,
        squared_error: square * result.relative_error.powi(2),
        square,
        iterations: result.iterations as u64,
        errors,
    };
    (lost, Some(group))
}

/// One array of each kind for all groups, as far as their images are kept.
fn assemble(geometry: Geometry, groups: Vec<Compressed>) -> Images {
    let members = Members::new(&geometry);
    let (mut list, mut masks, mut factors, mut scales) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for group in groups {
        let kept = group
            .images
            .iter()
            .filter(|&&image| image < geometry.images)
            .count();
        if kept == 0 {
            continue;
        }
        let vectors = &group.vectors;
        let mut mask = vec![0_u64; members.words];
        for &image in &group.images[..kept] {
            let local = members.local[image as usize] as usize;
            mask[local / 64] |= 1 << (local % 64);
        }
        list.push(
            Group {
                factors: factors.len() as u32,
                scales: scales.len() as u32,
                block: group.block,
                region: group.region,
                rank: vectors.rank as u8,
            }
            .packed(),
        );
        masks.extend(mask);
        factors.extend(&vectors.factors);
        factors.extend(&vectors.rows[..kept * vectors.rank]);
        let end = scales.len() + super::images::scales(vectors.rank);
        scales.extend(&vectors.scales);
        scales.resize(end, 0);
    }
    factors.extend([0; PADDING]);
    scales.extend([0; PADDING]);
    let parts = Parts {
        groups: list.into(),
        masks: masks.into(),
        factors: factors.into(),
        scales: scales.into(),
        totals: vec![0.0; geometry.images as usize].into(),
        ..Parts::default()
    };
    let mut images = Images::new(geometry, parts);
    images.weigh();
    images
}
