use super::*;

/// Values of the sum of `rank` products of random vectors, with components of falling weight.
fn low_rank(dims: [usize; 3], rank: usize, seed: u64) -> Vec<f32> {
    let factor = |mode: usize, row: usize, r: usize| f64::from(random(seed, [mode, row, r])) - 0.3;
    let value = |e: usize| {
        let [i, j, k] = [e % dims[0], e / dims[0] % dims[1], e / dims[0] / dims[1]];
        (0..rank)
            .map(|r| 0.7_f64.powi(r as i32) * factor(0, i, r) * factor(1, j, r) * factor(2, k, r))
            .sum::<f64>() as f32
    };
    (0..dims.iter().product()).map(value).collect()
}

/// Spots and a ridge, that move with the third index: what blocks of distributions of normals look like.
fn spots(dims: [usize; 3]) -> Vec<f32> {
    let value = |e: usize| {
        let [i, j, k] = [e % dims[0], e / dims[0] % dims[1], e / dims[0] / dims[1]];
        let (x, y) = (i as f32, j as f32);
        let ridge = (-(x - 0.4 * y - 3.0).powi(2) / 3.0).exp();
        let spots = (0..6).map(|s| {
            let [u, v, w] = [0, 1, 2].map(|n| random(7, [n, s, k]));
            let (u, v) = (u * dims[0] as f32, v * dims[1] as f32);
            w * (-((x - u).powi(2) + (y - v).powi(2)) / 2.0).exp()
        });
        ridge * random(8, [0, 0, k]) + spots.sum::<f32>()
    };
    (0..dims.iter().product()).map(value).collect()
}

fn residual(tensor: &Tensor, decomposition: &Decomposition) -> f64 {
    let [i, j, _] = tensor.dims;
    let (mut error, mut norm) = (0.0, 0.0);
    for (e, &value) in tensor.values.iter().enumerate() {
        let approximation = decomposition.value([e % i, e / i % j, e / i / j]);
        error += f64::from(value - approximation).powi(2);
        norm += f64::from(value).powi(2);
    }
    (error / norm).sqrt()
}

fn plain(rank: usize, max_iterations: usize) -> Options {
    Options {
        rank,
        max_iterations,
        ..Options::published()
    }
}

#[test]
fn tensors_of_low_rank_are_recovered() {
    for (dims, rank) in [
        ([7, 6, 20], 3),
        ([16, 16, 40], 6),
        ([16, 16, 1], 9),
        ([5, 1, 8], 4),
        ([3, 9, 2], 2),
    ] {
        let values = low_rank(dims, rank, 3);
        let tensor = Tensor {
            dims,
            values: &values,
        };
        for options in [
            plain(rank, 500),
            Options {
                rank,
                ..Options::default()
            },
        ] {
            // A start can lead into a local minimum.
            let attempts = (0..4).map(|seed| {
                decompose(
                    &tensor,
                    &Options {
                        seed,
                        ..options.clone()
                    },
                )
            });
            let best = attempts
                .min_by(|a, b| a.relative_error.total_cmp(&b.relative_error))
                .unwrap();
            assert!(best.relative_error < 2e-3, "{dims:?}: {}", best.relative_error);
            assert!((residual(&tensor, &best) - best.relative_error).abs() < 1e-5);
        }
    }
}

#[test]
fn error_falls_with_every_sweep_and_is_true() {
    let values = spots([16, 14, 30]);
    let tensor = Tensor {
        dims: [16, 14, 30],
        values: &values,
    };
    for options in [
        plain(8, 0),
        Options {
            rank: 8,
            ..Options::default()
        },
    ] {
        let mut last = f64::INFINITY;
        for max_iterations in 1..40 {
            let decomposition = decompose(
                &tensor,
                &Options {
                    max_iterations,
                    ..options.clone()
                },
            );
            let error = decomposition.relative_error;
            assert!(error < last + 1e-5, "{error} after {last}");
            assert!((residual(&tensor, &decomposition) - error).abs() < 1e-5);
            last = error;
        }
        assert!(last < 0.5, "{last}");
    }
}

/// Alternating least squares as in a textbook: explicit unfoldings, double precision, the normal equations by
/// elimination. Starts from X and Y, updates Z, X, Y, ..., Z; the relative error.
fn reference(tensor: &Tensor, rank: usize, seed: u64, sweeps: usize) -> f64 {
    let dims = tensor.dims;
    let at = |p: [usize; 3]| f64::from(tensor.values[(p[2] * dims[1] + p[1]) * dims[0] + p[0]]);
    let mut factors: Vec<Vec<Vec<f64>>> = (0..3)
        .map(|mode| {
            let row = |row| {
                (0..rank)
                    .map(|r| f64::from(random(seed, [mode, row, r])))
                    .collect()
            };
            (0..dims[mode]).map(row).collect()
        })
        .collect();
    let places: Vec<[usize; 3]> = (0..tensor.values.len())
        .map(|e| [e % dims[0], e / dims[0] % dims[1], e / dims[0] / dims[1]])
        .collect();
    let update = |factors: &mut Vec<Vec<Vec<f64>>>, mode: usize| {
        let others = [(mode + 1) % 3, (mode + 2) % 3];
        let mut gram = vec![vec![0.0; rank]; rank];
        for (a, row) in gram.iter_mut().enumerate() {
            for (b, value) in row.iter_mut().enumerate() {
                let inner = others.map(|m| factors[m].iter().map(|f| f[a] * f[b]).sum::<f64>());
                *value = inner[0] * inner[1];
            }
        }
        let mut right = vec![vec![0.0; rank]; dims[mode]];
        for &p in &places {
            for r in 0..rank {
                right[p[mode]][r] += at(p) * others.iter().map(|&m| factors[m][p[m]][r]).product::<f64>();
            }
        }
        factors[mode] = right
            .into_iter()
            .map(|right| eliminate(gram.clone(), right))
            .collect();
    };
    for sweep in 0..sweeps {
        if sweep > 0 {
            update(&mut factors, 0);
            update(&mut factors, 1);
        }
        update(&mut factors, 2);
    }
    let norm: f64 = places.iter().map(|&p| at(p).powi(2)).sum();
    let model = |p: [usize; 3]| -> f64 {
        (0..rank)
            .map(|r| (0..3).map(|m| factors[m][p[m]][r]).product::<f64>())
            .sum()
    };
    (places.iter().map(|&p| (at(p) - model(p)).powi(2)).sum::<f64>() / norm).sqrt()
}

/// Gaussian elimination with pivots from the diagonal.
fn eliminate(mut matrix: Vec<Vec<f64>>, mut right: Vec<f64>) -> Vec<f64> {
    let n = right.len();
    for column in 0..n {
        let (pivot_row, known) = (matrix[column].clone(), right[column]);
        for (row, value) in matrix.iter_mut().zip(&mut right).skip(column + 1) {
            let scale = row[column] / pivot_row[column];
            for (element, pivot) in row.iter_mut().zip(&pivot_row) {
                *element -= scale * pivot;
            }
            *value -= scale * known;
        }
    }
    for row in (0..n).rev() {
        let known: f64 = (row + 1..n).map(|k| matrix[row][k] * right[k]).sum();
        right[row] = (right[row] - known) / matrix[row][row];
    }
    right
}

#[test]
fn published_setting_agrees_with_plain_reference() {
    let values = spots([16, 16, 24]);
    let tensor = Tensor {
        dims: [16, 16, 24],
        values: &values,
    };
    for (rank, sweeps, tolerance) in [(4, 1, 1e-5), (4, 30, 1e-4), (11, 10, 1e-4), (16, 20, 1e-3)] {
        let error = decompose(&tensor, &plain(rank, sweeps)).relative_error;
        let expected = reference(&tensor, rank, 0, sweeps);
        assert!(
            (error - expected).abs() < tolerance,
            "rank {rank}: {error}, reference {expected}"
        );
    }
}

#[test]
fn zero_tensors_and_too_high_ranks_have_finite_answers() {
    for dims in [[16, 16, 0], [16, 16, 5], [1, 1, 1], [0, 0, 0]] {
        let values = vec![0.0; dims.iter().product()];
        let decomposition = decompose(
            &Tensor {
                dims,
                values: &values,
            },
            &Options::default(),
        );
        assert_eq!(
            (decomposition.relative_error, decomposition.condition),
            (0.0, 0.0)
        );
        assert!(decomposition.factors.iter().flatten().all(|&v| v == 0.0));
    }
    for dims in [[1, 1, 1], [2, 3, 1], [16, 16, 2], [4, 4, 4]] {
        for (fill, scale) in [(1, 1.0), (3, 1e-30), (3, 1e18)] {
            // Every `fill`-th value is not zero.
            let values: Vec<f32> = (0..dims.iter().product())
                .map(|e| {
                    if e % fill == 0 {
                        scale * (1.0 + random(1, [e, 0, 0]))
                    } else {
                        0.0
                    }
                })
                .collect();
            let tensor = Tensor {
                dims,
                values: &values,
            };
            for options in [
                plain(24, 500),
                Options {
                    rank: 24,
                    ..Options::default()
                },
            ] {
                let decomposition = decompose(&tensor, &options);
                assert!(
                    decomposition.factors.iter().flatten().all(|v| v.is_finite()),
                    "{dims:?} {scale}"
                );
                assert!(
                    decomposition.relative_error < 0.02,
                    "{dims:?} {scale}: {}",
                    decomposition.relative_error
                );
            }
        }
    }
}

#[test]
fn columns_are_unit_vectors_or_zero() {
    let values = spots([16, 16, 10]);
    let decomposition = decompose(
        &Tensor {
            dims: [16, 16, 10],
            values: &values,
        },
        &Options::default(),
    );
    let mut squares = 0.0;
    for r in 0..16 {
        let norm = |mode: usize| {
            let column = decomposition.factors[mode].iter().skip(r).step_by(16);
            column.map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt()
        };
        for mode in [0, 1] {
            assert!(norm(mode) == 0.0 || (norm(mode) - 1.0).abs() < 1e-5);
        }
        squares += norm(2).powi(2);
    }
    let norm = values.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>();
    assert!((decomposition.condition - (squares / norm).sqrt()).abs() < 1e-4);
}

#[test]
fn same_seed_same_answer() {
    let values = spots([16, 16, 20]);
    let tensor = Tensor {
        dims: [16, 16, 20],
        values: &values,
    };
    let with_seed = |seed| {
        decompose(
            &tensor,
            &Options {
                rank: 20,
                seed,
                ..Options::default()
            },
        )
    };
    assert!(with_seed(1) == with_seed(1));
    assert!(with_seed(1).factors != with_seed(2).factors);
}

/// a a b + a b a + b a a has rank 3, but tensors of rank 2 come arbitrarily close, with components that grow without
/// bound (de Silva and Lim 2008, Section 4.7).
#[test]
fn ridge_bounds_degenerate_components() {
    let values = [0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0];
    let tensor = Tensor {
        dims: [2, 2, 2],
        values: &values,
    };
    let with_ridge = |ridge| {
        let options = Options {
            rank: 2,
            max_iterations: 20_000,
            tolerance: 1e-6,
            ridge,
            ..Options::published()
        };
        decompose(&tensor, &options)
    };
    let (free, bounded) = (with_ridge(0.0), with_ridge(1e-3));
    assert!(free.condition > 8.0, "{}", free.condition);
    assert!(bounded.condition < 4.0, "{}", bounded.condition);
    assert!(bounded.relative_error < 0.2, "{}", bounded.relative_error);
}

#[test]
fn lowest_sufficient_rank_is_taken() {
    let values = low_rank([16, 16, 20], 10, 5);
    let tensor = Tensor {
        dims: [16, 16, 20],
        values: &values,
    };
    let ranks = [4, 8, 12, 16];
    assert_eq!(decompose_to(&tensor, &ranks, 0.02, &Options::default()).rank, 12);
    assert_eq!(decompose_to(&tensor, &ranks, 0.9, &Options::default()).rank, 4);
    assert_eq!(decompose_to(&tensor, &ranks, 0.0, &Options::default()).rank, 16);
}
