"""Lines of bench.json."""


def make_record(name, value, unit, baseline, baseline_value, params):
    """A line of bench.json."""
    return {
        "name": name,
        "value": value,
        "unit": unit,
        "baseline": baseline,
        "baseline_value": baseline_value,
        "ratio": value / baseline_value,
        "params": params,
    }
