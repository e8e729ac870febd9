"""Verdicts of image comparisons in words, the same on the terminal, in the page and in a failing test's message."""

from .statistic import FAMILIES, ExactComparison


def describe(comparison):
    """The verdict in a sentence or two."""
    invalid = nonfinite_text(comparison)
    if isinstance(comparison, ExactComparison):
        return exact_text(comparison) + invalid
    if not comparison.tests:
        return f"different: pixels that are not finite cannot be compared{invalid}"
    verdict = "different" if comparison.different else "the same up to noise"
    families = {name: comparison.family_p(name) for name in FAMILIES}
    values = ", ".join(f"{name} {p_text(p)}" for name, p in families.items() if p is not None)
    worst = comparison.findings()[0]
    where = f"; most conspicuous: {worst.feature}, {worst.place}, {change_text(worst)}"
    return f"{verdict} (corrected p: {values}; alpha {comparison.alpha:.2g}){where}"


def exact_text(comparison):
    """The verdict on two single images."""
    count, total = int(comparison.differing.sum()), comparison.differing.size
    if not count:
        return f"the same within {comparison.tolerance:g}"
    limits = f"by more than {comparison.tolerance:g}, by up to {comparison.largest:.4g}"
    return f"different: {count} of {total} pixels {limits}"


def nonfinite_text(comparison):
    """Infinite and undefined pixels of both sides, if there are any."""
    counts = [
        f"{side.nonfinite} in {name}" for name, side in (("A", comparison.a), ("B", comparison.b)) if side.nonfinite
    ]
    return f" (infinite or undefined pixels: {', '.join(counts)})" if counts else ""


def change_text(finding):
    """How far A is from B in a block."""
    if finding.mean_b == 0:
        return f"{finding.mean_a:.4g} against 0"
    return f"{finding.mean_a:.4g} against {finding.mean_b:.4g}, {finding.mean_a / finding.mean_b - 1:+.1%}"


def side_text(side):
    """Size and seeds of a side."""
    height, width = side.mean.shape[:2]
    return f"{width} x {height} pixels, {side.seeds} seed{'s' if side.seeds != 1 else ''}"


def p_text(p):
    """A p-value for people."""
    return "< 1e-300" if p < 1e-300 else f"{p:.2g}"
