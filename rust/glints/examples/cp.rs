//! Decomposes tensors that another program has written, and says how well and how fast.
//!
//! A file of tensors is, for each, three dimensions as 32-bit integers and its values as 32-bit floats in the order of
//! `glints::methods::tensor::cp::Tensor`, all little-endian. Written is a line of JSON for each, with the time of one
//! thread in milliseconds; with `--factors` also a file of the three factors of each, one behind the other.
//!
//! ```text
//! cargo run --release -p glints --example cp -- groups.bin --rank 16 --published
//! ```

use std::error::Error;
use std::fs;
use std::path::PathBuf;
use std::time::Instant;

use clap::Parser;
use glints::methods::tensor::cp::{Options, Tensor, decompose, decompose_to};
use serde_json::json;

#[derive(Parser)]
struct Arguments {
    /// The file of tensors.
    tensors: PathBuf,
    /// Number of components; several, ascending, with `--target`.
    #[arg(long, value_delimiter = ',', default_value = "16")]
    rank: Vec<usize>,
    /// Takes the lowest of the ranks that reaches this relative error.
    #[arg(long, default_value_t = 0.0)]
    target: f64,
    /// The setting of Deng et al. 2022 instead of the default one.
    #[arg(long)]
    published: bool,
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Writes the factors to this file.
    #[arg(long)]
    factors: Option<PathBuf>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments = Arguments::parse();
    let bytes = fs::read(&arguments.tensors)?;
    if bytes.len() % 4 != 0 {
        return Err(format!("{} is not a file of tensors", arguments.tensors.display()).into());
    }
    let words: Vec<[u8; 4]> = bytes
        .chunks_exact(4)
        .map(|word| [word[0], word[1], word[2], word[3]])
        .collect();
    let options = Options {
        seed: arguments.seed,
        rank: arguments.rank[0],
        ..if arguments.published {
            Options::published()
        } else {
            Options::default()
        }
    };
    let mut factors = Vec::new();
    let mut rest = words.as_slice();
    while !rest.is_empty() {
        let (dims, values) = next_tensor(&mut rest)
            .ok_or_else(|| format!("{} ends within a tensor", arguments.tensors.display()))?;
        let tensor = Tensor {
            dims,
            values: &values,
        };
        let start = Instant::now();
        let decomposition = if arguments.rank.len() > 1 {
            decompose_to(&tensor, &arguments.rank, arguments.target, &options)
        } else {
            decompose(&tensor, &options)
        };
        let line = json!({
            "milliseconds": start.elapsed().as_secs_f64() * 1e3,
            "dims": dims,
            "rank": decomposition.rank,
            "relative_error": decomposition.relative_error,
            "condition": decomposition.condition,
            "iterations": decomposition.iterations,
        });
        println!("{line}");
        factors.extend(
            decomposition
                .factors
                .iter()
                .flatten()
                .flat_map(|value| value.to_le_bytes()),
        );
    }
    if let Some(path) = arguments.factors {
        fs::write(path, factors)?;
    }
    Ok(())
}

fn next_tensor(rest: &mut &[[u8; 4]]) -> Option<([usize; 3], Vec<f32>)> {
    let (dims, values) = rest.split_at_checked(3)?;
    let dims = [0, 1, 2].map(|k| u32::from_le_bytes(dims[k]) as usize);
    let (values, others) = values.split_at_checked(dims.iter().product())?;
    *rest = others;
    Some((
        dims,
        values.iter().map(|&word| f32::from_le_bytes(word)).collect(),
    ))
}
