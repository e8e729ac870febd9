"""How often the image test is wrong: false alarms on equal renderings, and the smallest changes that it finds.

A pool of many seeds of one configuration is split at random, again and again, into test seeds and reference seeds. The
test is then applied as in `tests/test_images.py`, first to the split as it is (every rejection is a false alarm), then
to test seeds that were changed. Splits share seeds, so that a rate's own uncertainty is a little larger than the
binomial one.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import stats

from ..cli import ROOT
from ..files import write_text
from . import statistic
from .cases import CONFIGURATIONS, REFERENCE_SEEDS, TEST_SEEDS, open_scene, shifted_map

PAGE = ROOT / "docs" / "image-tests.md"
BEGIN, END = "<!-- calibration: begin -->", "<!-- calibration: end -->"

POOL = range(10_000, 10_768)
CHANGED = range(20_000, 20_096)
"""Seeds of the pool, and of renderings that were changed: none of the tests'."""

LEVELS = (0.05, 0.01, 0.001)
SPLITS, POWER_SPLITS = 1_000, 100
POWER = 0.9

NULLS = ("shoes-ibm-pixel", "kettle-ibm-pixel", "shoes-yan16-flat", "shoes-unfiltered", "kettle-unfiltered")

BRIGHTNESS_CHANGES = (0.01, 0.02, 0.03, 0.05, 0.1)
FOOTPRINTS = (1.05, 1.1, 1.2, 1.3, 1.5, 2.0)
BINS = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)


@dataclass(frozen=True)
class Split:
    """Seeds of a pool, drawn at random: for the test, and for the reference."""

    test: np.ndarray
    reference: np.ndarray


def splits(rng, count, reference):
    """Random splits with `reference` seeds for the reference."""
    for _ in range(count):
        order = rng.permutation(len(POOL))
        yield Split(order[: len(TEST_SEEDS)], order[len(TEST_SEEDS) :][:reference])


def pick(images, index):
    """Some of the seeds."""
    return replace(images, values=images.values[index])


def stored_reference(images, index):
    """What is kept of some of the seeds."""
    chosen = pick(images, index)
    return chosen.moments(statistic.compression_scale(chosen.mean.mean()))


def false_alarms(images, rng, stored=True):
    """Corrected p-values of equal renderings: against a stored reference, or against as many seeds as are tested."""
    values = []
    for split in splits(rng, SPLITS, len(REFERENCE_SEEDS if stored else TEST_SEEDS)):
        other = stored_reference(images, split.reference) if stored else pick(images, split.reference)
        values.append(statistic.compare(pick(images, split.test), other).p)
    return np.array(values)


def power(images, changed, rng):
    """Share of splits in which changed renderings are found, and the family of features that finds most of them.

    `changed` is a function from a split to `Seeds`.
    """
    found, families = 0, {name: 0 for name in statistic.FAMILIES}
    for split in splits(rng, POWER_SPLITS, len(REFERENCE_SEEDS)):
        comparison = statistic.compare(changed(split), stored_reference(images, split.reference))
        found += comparison.different
        for name in families:
            families[name] += comparison.family_p(name) < comparison.alpha
    return found / POWER_SPLITS, max(families, key=families.get)


def brighter(images, change):
    """Test seeds made brighter by a factor."""
    return lambda split: replace(images, values=images.values[split.test] * (1 + change))


def others(images, rng):
    """Seeds of another rendering."""
    return lambda split: pick(images, rng.choice(images.count, len(split.test), replace=False))


def smallest_found(changes, measure):
    """The smallest change that is found with probability `POWER`, and its (share, family); None if none is.

    A change counts only if all larger ones are found, too.
    """
    best = None
    for change in sorted(changes, reverse=True):
        share, name = measure(change)
        if share < POWER:
            break
        best = (change, share, name)
    return best


def power_rows(name, images, rng, say):
    """Rows of the table of power: what is changed, the scene, the smallest change found, the share, the family."""
    configuration = CONFIGURATIONS[name]

    def footprint(width):
        return power(images, others(configuration.with_footprint(str(width)).images(CHANGED), rng), rng)

    def shift(bins):
        with tempfile.TemporaryDirectory() as folder:
            path = shifted_map(configuration.scene, bins, Path(folder) / "shifted.exr")
            return power(images, others(configuration.with_map(path).images(CHANGED), rng), rng)

    for label, unit, changes, measure in (
        ("brightness", "+{:.2%}", BRIGHTNESS_CHANGES, lambda change: power(images, brighter(images, change), rng)),
        ("width of the footprint", "x{:g}", FOOTPRINTS, footprint),
        ("normals moved", "{:g} bins", BINS, shift),
    ):
        say(f"{name}: power against {label}")
        found = smallest_found(changes, measure)
        if found is None:
            yield label, configuration.scene, f"more than {unit.format(max(changes))}", "", ""
        else:
            change, share, by = found
            yield label, configuration.scene, unit.format(change), f"{share:.0%}", by


def rate_text(values, level):
    """A rate of false alarms with its 95 % interval (Clopper and Pearson)."""
    count = int(np.sum(values < level))
    interval = stats.binomtest(count, len(values)).proportion_ci(0.95)
    return f"{count / len(values):.2%} ({interval.low:.2%} to {interval.high:.2%})"


def own_roughness(configuration):
    """The same with the flake roughness that the scene really has."""
    return replace(configuration, values={"alpha": open_scene(configuration.scene).values["alpha"]})


def table(heading, rows):
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(map(str, row))} |" for row in (heading, ["---"] * len(heading), *rows))


def measure(say):
    """Both tables, in Markdown."""
    rng = np.random.default_rng(0)
    alarms, found = [], []
    cases = [(name, CONFIGURATIONS[name]) for name in NULLS]
    cases.append((f"{NULLS[0]}, the scene's own roughness", own_roughness(CONFIGURATIONS[NULLS[0]])))
    for label, configuration in cases:
        say(f"{label}: {len(POOL)} seeds, false alarms")
        images = configuration.images(POOL)
        for stored in (True, False):
            values = false_alarms(images, rng, stored)
            sizes = f"{len(TEST_SEEDS)} against {f'stored {len(REFERENCE_SEEDS)}' if stored else len(TEST_SEEDS)}"
            alarms.append((label, sizes, *(rate_text(values, level) for level in LEVELS)))
        if label in ("shoes-ibm-pixel", "kettle-ibm-pixel"):
            found += power_rows(label, images, rng, say)
    return (
        f"False alarms in {SPLITS} splits of {len(POOL)} seeds each, with the 95 % interval:\n\n"
        + table(("images", "seeds", *(f"alpha {level:g}" for level in LEVELS)), alarms)
        + f"\n\nThe smallest change (of those tried) that is found in {POWER:.0%} of {POWER_SPLITS} splits, with "
        + f"alpha {statistic.ALPHA:g}, {len(TEST_SEEDS)} seeds against stored {len(REFERENCE_SEEDS)}:\n\n"
        + table(("change of `glints_ibm`", "scene", "smallest found", "in", "mostly by"), found)
    )


def put_between(text, tables):
    """A page with other tables between the marks."""
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n\n{tables}\n\n{END}{after}"


def run(say):
    """Measure, and put the tables into the docs."""
    tables = measure(say)
    say(tables)
    write_text(PAGE, put_between(PAGE.read_text(encoding="utf-8"), tables))
    say(f"wrote the tables of {PAGE}")
