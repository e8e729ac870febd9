"""Images of both scenes through every plugin, against stored references, and broken twins that must fail.

Two questions. Does a plugin still render what it rendered when its reference was stored? A few seeds are compared with
the reference by the test of `glints_harness.imagediff`, which sees brightness, misplaced glints and lost filtering.
And was that right? The stored references of the filters are held against that of the same surface without a filter,
within stated biases; this takes no rendering. `./scripts/references` renders the references anew.

docs/image-tests.md has a table of the broken twins; a test holds it against `TWINS`.
"""

import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import support
import test_distribution
from glints_harness.imagediff import cases, page, statistic, storage
from glints_harness.imagediff.cases import CONFIGURATIONS, TEST_SEEDS
from glints_harness.imagediff.text import describe

ROOT = Path(__file__).resolve().parents[1]

# Each configuration's share of a false alarm in a thousand runs of all of them, each with new seeds.
ALPHA = 1 - (1 - statistic.ALPHA) ** (1 / len(CONFIGURATIONS))


def compared(configuration, name):
    """The comparison of a configuration's renderings with the stored reference `name`."""
    return statistic.compare(configuration.images(TEST_SEEDS), cases.stored(name), alpha=ALPHA)


def assert_same(name, comparison, folder=ROOT / "out" / "imagediff"):
    """Fail with a page to look at if a comparison finds a difference."""
    if comparison.different:
        left = Path(folder) / f"{name}.html"
        settings = {"A": "this build", "B": f"stored reference {name}"}
        page.write(left, [(name, comparison)], settings)
        pytest.fail(f"{name} is {describe(comparison)}\nLook at {left}", pytrace=False)


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_images_are_those_of_the_stored_reference(name):
    assert_same(name, compared(CONFIGURATIONS[name], name))


def test_every_stored_reference_is_used():
    assert {path.stem for path in cases.FOLDER.glob("*.exr")} == set(CONFIGURATIONS)


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_stored_reference_says_where_it_comes_from(name):
    """Rendered with the settings of the tests, from a commit; `./scripts/references` sees to both."""
    origin = storage.provenance_of(cases.FOLDER / f"{name}.exr")
    assert re.fullmatch("[0-9a-f]{40}", origin["commit"]), f"{origin['commit']}: run ./scripts/references"
    assert origin["spp"] == cases.SPP and origin["alpha"] == cases.ALPHA
    assert origin["crop"] == list(CONFIGURATIONS[name].view().crop)
    assert not set(range(origin["seeds"][0], origin["seeds"][1] + 1)) & set(TEST_SEEDS)


# ---- the stored references against the surface without a filter -----------------------------------------------------

BLOCK = 16
# Footprints of a pixel's size blur by up to a pixel on top of the pixel itself; the surface is flat under them.
STATED_BIAS = 0.05
# Variance of one seed against the unfiltered surface's.
LARGEST_VARIANCE_RATIO = {"shoes": 0.15, "kettle": 0.6}

FILTERED = [
    # method, its surface without a filter, largest distance of the compressed mean images in both scenes
    ("ibm-pixel", "unfiltered", 0.2),
    ("direct", "unfiltered", 0.2),
    # Its Gaussian, of half a pixel's standard deviation, is 1.7 times as wide as a pixel.
    ("yan16-flat", "unfiltered", 0.26),
    ("yan16-curved", "unfiltered-interpolated", 0.2),
]


def brightness(moments):
    """The channels' mean over blocks, and its standard error."""
    blocks = moments.blocks(None, statistic.Grid(moments.shape, BLOCK)).pick(moments.channels)
    return blocks.means, np.sqrt(blocks.variances / blocks.count)


def compressed(moments):
    """The mean image with its highlights compressed, so that one bright glint does not decide a comparison."""
    mean = moments.mean.mean(axis=-1)
    return mean / (0.3 + mean)


def distance(moments, truth):
    return np.abs(compressed(moments) - compressed(truth)).mean() / compressed(truth).mean()


def variance(moments):
    return moments.variances[..., : len(moments.channels)].mean()


def brightness_is_right(moments, truth):
    """Every block's mean agrees within five standard errors plus the stated bias."""
    (found, error), (expected, truth_error) = brightness(moments), brightness(truth)
    return bool(np.all(np.abs(found - expected) < 5 * np.hypot(error, truth_error) + STATED_BIAS * expected))


@pytest.mark.parametrize("scene", ["shoes", "kettle"])
@pytest.mark.parametrize("method, surface, largest_distance", FILTERED)
def test_stored_filters_agree_with_the_unfiltered_surface(scene, method, surface, largest_distance):
    moments, truth = (cases.stored(f"{scene}-{name}") for name in (method, surface))
    assert brightness_is_right(moments, truth)
    assert distance(moments, truth) < largest_distance
    assert variance(moments) < LARGEST_VARIANCE_RATIO[scene] * variance(truth)


@pytest.mark.parametrize("scene", ["shoes", "kettle"])
def test_these_bounds_can_be_missed(scene):
    """Footprints of two pixels are too far from the truth, no filter is too noisy, and a fifth is too bright."""
    truth, wide, noisy = (
        cases.stored(f"{scene}-{name}") for name in ("unfiltered", "ibm-2-pixels", "unfiltered-interpolated")
    )
    assert distance(wide, truth) > max(largest for _, _, largest in FILTERED)
    assert variance(noisy) > LARGEST_VARIANCE_RATIO[scene] * variance(truth)
    assert not brightness_is_right(brighter(truth, 1.2), truth)


def brighter(moments, factor):
    """A reference made brighter."""
    return statistic.Moments(
        moments.names, moments.means * factor, moments.variances * factor**2, moments.count, moments.scale
    )


# ---- broken twins ---------------------------------------------------------------------------------------------------

TWINS = {
    # fault: how the rendering is broken, the feature that has to tell
    "filter off": (lambda base, _: base.with_footprint("0"), statistic.NOISE),
    "footprint doubled": (lambda base, _: base.with_footprint("2"), statistic.PLACEMENT),
    "bins shifted by one": (
        lambda base, folder: base.with_map(cases.shifted_map(base.scene, 1, folder / "shifted.exr")),
        statistic.BRIGHTNESS,
    ),
    "Fresnel dropped": (lambda base, _: base.with_parameters(material="none"), statistic.BRIGHTNESS),
}


@pytest.mark.parametrize("scene", ["shoes", "kettle"])
@pytest.mark.parametrize("fault", TWINS)
def test_broken_image_is_caught(fault, scene, tmp_path):
    """A twin of `glints_ibm`, rendered through the plugins, is told from the stored reference by the feature named."""
    name = f"{scene}-ibm-pixel"
    broken, feature = TWINS[fault]
    comparison = compared(broken(CONFIGURATIONS[name], tmp_path), name)
    assert comparison.family_p(feature) < ALPHA, describe(comparison)
    with pytest.raises(pytest.fail.Exception, match="Look at"):
        assert_same(name, comparison, tmp_path)


def test_broken_density_is_caught(rough_map):
    """A twin whose `pdf` is off by the cosine of the outgoing direction fails the test that the plugin passes."""
    bsdf = support.bsdf("glints_ibm", rough_map, alpha=0.16)
    si = test_distribution.vertex("texels", "grazing")
    bins = test_distribution.bins_per_side(0.16)
    counts, _ = test_distribution.draw_cells(bsdf, si, bins, 20_000, np.random.default_rng(3))

    def p_value(factor):
        def density(wo):
            return factor(wo) * bsdf.pdf(mi.BSDFContext(), si, mi.Vector3f(*wo))

        found = test_distribution.integrate_cells(si, bins, density)
        # What `pdf` leaves of one are samples below the horizon, which `sample` reports as failures.
        return test_distribution.chi_square(counts, np.append(found, max(0.0, 1 - found.sum())))

    assert p_value(lambda wo: 1.0) > 1e-4
    # Also if the twin is normalised, so that only the shape of its density is wrong.
    total = test_distribution.integrate_cells(
        si, bins, lambda wo: wo[2] * bsdf.pdf(mi.BSDFContext(), si, mi.Vector3f(*wo))
    ).sum()
    failed = counts[-1] / counts.sum()
    assert p_value(lambda wo: wo[2]) < 1e-12
    assert p_value(lambda wo: wo[2] * (1 - failed) / total) < 1e-12


def test_table_of_twins_is_true():
    """docs/image-tests.md names every twin, the test that catches it, and by what."""
    text = (ROOT / "docs" / "image-tests.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.+?) \| `tests/test_images.py::(\w+)` \| (.+?) \|", text, flags=re.MULTILINE)
    expected = [(fault, test_broken_image_is_caught.__name__, feature) for fault, (_, feature) in TWINS.items()]
    assert rows == [*expected, ("`pdf` off by a cosine", test_broken_density_is_caught.__name__, "chi-square")]
