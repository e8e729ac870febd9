//! Lines of the output, and what sums up all cells of a map.

use serde_json::{Value, json};

/// Prints one line.
pub fn print(name: &str, value: f64, unit: &str, (baseline, baseline_value): (&str, f64), params: &Value) {
    let row = json!({
        "name": name, "value": value, "unit": unit, "baseline": baseline, "baseline_value": baseline_value,
        "ratio": value / baseline_value, "params": params,
    });
    println!("{row}");
}

/// Parameters with further entries.
pub fn with(params: &Value, entries: &[(&str, Value)]) -> Value {
    let mut params = params.clone();
    for (name, value) in entries {
        params[name] = value.clone();
    }
    params
}

/// What was measured in every cell of a map, with the cell's parameters.
pub struct Summary {
    name: &'static str,
    /// Nanoseconds of an evaluation.
    pub evals: Vec<(f64, Value)>,
    /// Errors of the distribution of normals, where they were measured.
    pub errors: Vec<(f64, Value)>,
}

impl Summary {
    pub fn new(name: &'static str) -> Self {
        Self {
            name,
            evals: Vec::new(),
            errors: Vec::new(),
        }
    }

    /// Prints the extremes beside those of another structure; `params` are those of the map, for what has no cell.
    pub fn print(&self, other: &Self, params: &Value) {
        let row = |what: &str, unit: &str, of: &dyn Fn(&Self) -> Option<(f64, Value)>| {
            if let (Some((value, params)), Some((baseline, _))) = (of(self), of(other)) {
                let params = with(&params, &[("cells", json!(self.evals.len()))]);
                let name = format!("{}/{what}", self.name);
                print(&name, value, unit, (other.name, baseline), &params);
            }
        };
        row("eval/worst", "nanoseconds", &|summary| worst(&summary.evals));
        row("eval/median", "nanoseconds", &|summary| {
            Some((median(&summary.evals)?, params.clone()))
        });
        row("eval/worst_over_best", "ratio", &|summary| {
            let (worst, params) = worst(&summary.evals)?;
            Some((worst / best(&summary.evals)?, params))
        });
        row("ndf_error/worst", "relative L1", &|summary| {
            worst(&summary.errors)
        });
    }
}

fn worst(cells: &[(f64, Value)]) -> Option<(f64, Value)> {
    cells.iter().max_by(|a, b| a.0.total_cmp(&b.0)).cloned()
}

fn best(cells: &[(f64, Value)]) -> Option<f64> {
    cells.iter().map(|cell| cell.0).min_by(f64::total_cmp)
}

fn median(cells: &[(f64, Value)]) -> Option<f64> {
    let mut values: Vec<f64> = cells.iter().map(|cell| cell.0).collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
