"""The image test itself, on synthetic heavy-tailed images: false alarms, power, files, exit statuses, the page."""

import html.parser

import mitsuba as mi
import numpy as np
import pytest
from glints_harness.imagediff import calibration, cli, references, statistic, storage
from glints_harness.imagediff.statistic import BadInput, Moments, Seeds, compare

SIDE = 24
RGB = ("R", "G", "B")


def glints(seeds, seed=0, tail=1.5, scene=0):
    """Images of a pattern of highlights with log-normal noise: a pixel is at times a hundred times its mean."""
    pattern = np.random.default_rng(scene).gamma(0.5, 2.0, size=(SIDE, SIDE, 1)) + 0.05
    noise = np.random.default_rng(seed + 1).lognormal(-(tail**2) / 2, tail, size=(seeds, SIDE, SIDE, 1))
    values = pattern * noise * np.array([1.0, 0.8, 0.5])
    return Seeds(values.astype(np.float32), RGB)


def stored(images):
    return images.moments(statistic.compression_scale(images.mean.mean()))


def changed(images, values):
    return Seeds(np.asarray(values, dtype=np.float32), images.channels)


# ---- the statistic --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [stored, lambda images: images], ids=["stored", "seeds"])
def test_false_alarms_are_as_rare_as_promised(kind):
    """At alpha = 0.1, 200 pairs of equal images: 20 alarms are expected, 34 or more in one run of a thousand.

    Far fewer would be a test that sees nothing.
    """
    alarms = 0
    for trial in range(200):
        a, b = glints(8, 2 * trial), glints(24, 100_000 + trial)
        alarms += compare(a, kind(b), alpha=0.1).different
    assert 3 <= alarms < 34


def test_student_is_scipys():
    """One block of two images of numbers, against `scipy.stats.ttest_ind`."""
    from scipy import stats

    rng = np.random.default_rng(1)
    x, y = rng.random(7), rng.random(12) + 0.3
    a, b = (Seeds(values.reshape(-1, 1, 1, 1), ("Y",)) for values in (x, y))
    for means_only in (False, True):
        test = compare(a, b, means_only=means_only).tests[0]
        expected = stats.ttest_ind(x, y, equal_var=not means_only)
        assert test.feature == "Y"
        assert test.t.item() == pytest.approx(expected.statistic, rel=1e-6)
        assert test.p.item() == pytest.approx(expected.pvalue, rel=1e-5)


def test_moments_and_seeds_give_the_same_means():
    images = glints(12)
    grid = statistic.Grid(images.shape, 7)
    ours, theirs = images.blocks(1.0, grid), images.moments(1.0).blocks(1.0, grid)
    assert ours.names == theirs.names == (*RGB, statistic.PLACEMENT, statistic.NOISE)
    np.testing.assert_allclose(ours.means, theirs.means, rtol=1e-6)
    # Independent pixels: the variances agree in the mean over blocks and features, here within their spread.
    assert (ours.variances / theirs.variances).mean() == pytest.approx(1, abs=0.25)
    # The mean of the noise is the variance of the placement.
    moments = images.moments(1.0)
    np.testing.assert_allclose(moments.means[..., 4], moments.variances[..., 3], rtol=1e-9)


def test_blocks_cover_the_image():
    grid = statistic.Grid((19, 33), 8)
    assert grid.pixels.shape == (2, 4) and grid.pixels.sum() == 19 * 33
    assert grid.place(1, 3) == "x 24 to 32, y 8 to 18"
    assert statistic.Grid((3, 3), 8).pixels.tolist() == [[9]]


def test_sidak():
    assert statistic.sidak(0.01, 10) == pytest.approx(1 - 0.99**10)
    assert statistic.sidak(1e-20, 10) == pytest.approx(1e-19)
    assert statistic.sidak(1.0, 3) == 1


FAULTS = {
    # what is changed: (from seeds' values to other values, the feature that must tell)
    "brighter": (lambda x: x * 1.3, statistic.BRIGHTNESS),
    "one block brighter": (lambda x: x * np.where(np.arange(SIDE) < 8, 2.0, 1)[:, None, None], statistic.BRIGHTNESS),
    "colour": (lambda x: x * np.array([1, 1, 1.2]), statistic.BRIGHTNESS),
    "shifted by a pixel": (lambda x: np.roll(x, 1, axis=2), statistic.PLACEMENT),
    "noisier": (lambda x: x.mean(0) * (x / x.mean(0)) ** 1.4, statistic.NOISE),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_found(fault):
    change, feature = FAULTS[fault]
    images = glints(16, 7, tail=1.0)
    reference = stored(glints(200, 8, tail=1.0))
    assert not compare(images, reference).different
    comparison = compare(changed(images, change(images.values.astype(float))), reference, block=6)
    assert comparison.different
    assert comparison.family_p(feature) < statistic.ALPHA


def test_means_only_lets_the_noise_differ():
    noisy, smooth = glints(16, 1, tail=1.2), glints(16, 2, tail=0.3)
    assert compare(noisy, smooth).different
    assert not compare(noisy, smooth, means_only=True).different
    assert compare(changed(noisy, noisy.values * 1.4), smooth, means_only=True).different


def test_one_seed_against_a_reference():
    reference = stored(glints(100, 3))
    one = glints(1, 4)
    comparison = compare(one, reference)
    assert not comparison.different and comparison.family_p(statistic.NOISE) is None
    assert compare(changed(one, one.values * 3), reference).different


def test_rounding_is_no_difference():
    """Noiseless parts, such as a visible light source, differ in the last bit between machines."""
    flat = np.full((8, SIDE, SIDE, 3), 0.3, np.float32)
    other = np.nextafter(flat, np.float32(1))
    assert not compare(changed(glints(1), flat), changed(glints(1), other)).different
    assert compare(changed(glints(1), flat), changed(glints(1), flat * 1.001)).different
    black = np.zeros_like(flat)
    assert not compare(changed(glints(1), black), changed(glints(1), black)).different
    assert compare(changed(glints(1), black), changed(glints(1), flat)).different


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_pixels_that_are_not_finite_are_counted_and_never_the_same(value):
    images = glints(6, 1)
    images.values[2, 3, 4, 1] = value
    images.values[5, 0, 0, :] = value
    for a, b in ((images, glints(6, 2)), (glints(6, 2), images), (images, images)):
        assert compare(a, b).different
    assert compare(images, glints(6, 2)).a.nonfinite == 2


def test_one_call_is_corrected_for_all_its_images():
    pairs = [compare(glints(6, 10 + i), glints(6, 50 + i)) for i in range(4)]
    total = sum(item.own_size for item in pairs)
    for alone, joint in zip(pairs, statistic.together(pairs)):
        smallest = min(test.p.min() for test in alone.tests)
        assert alone.p == pytest.approx(statistic.sidak(smallest, total / 4))
        assert joint.p == pytest.approx(statistic.sidak(smallest, total))


# ---- the command ----------------------------------------------------------------------------------------------------


def write(path, image, **more):
    path.parent.mkdir(parents=True, exist_ok=True)
    mi.Bitmap(np.ascontiguousarray(image), **more).write(str(path))
    return path


def write_seeds(folder, name, images):
    for index, image in enumerate(images.values):
        write(folder / f"{name}-seed{index}.exr", image)
    return folder


@pytest.fixture
def command(capsys):
    """Runs the command; returns exit status, standard output and standard error."""

    def run(*arguments):
        try:
            status = cli.main([str(item) for item in arguments])
        except SystemExit as exit:  # argparse
            status = exit.code
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


def test_single_images(command, tmp_path):
    image = glints(1).values[0]
    a, b = write(tmp_path / "a.exr", image), write(tmp_path / "b.exr", image)
    assert command(a, b)[0] == 0
    nearly = write(tmp_path / "nearly.exr", np.nextafter(image, np.float32(np.inf)))
    assert command(a, nearly)[0] == 0
    assert command(a, nearly, "--tolerance", 0)[0] == 1
    other = image.copy()
    other[3, 4] *= 1.01
    status, out, _ = command(a, write(tmp_path / "other.exr", other))
    assert status == 1
    for fragment in (f"1 of {SIDE * SIDE} pixels", "rmse", "mean_error"):
        assert fragment in out
    assert command(a, tmp_path / "other.exr", "--tolerance", 0.02)[0] == 0
    assert command(a, tmp_path / "other.exr", "--quiet")[1] == ""


def test_single_images_with_pixels_that_are_not_finite(command, tmp_path):
    image = glints(1).values[0]
    image[0, 0] = [np.nan, np.inf, 1]
    a, b = write(tmp_path / "a.exr", image), write(tmp_path / "b.exr", image)
    status, out, _ = command(a, b)
    assert status == 0 and "1 in A, 1 in B" in out
    image[0, 0] = [np.nan, -np.inf, 1]
    assert command(a, write(tmp_path / "c.exr", image))[0] == 1


def test_half_floats_grey_and_other_channels(command, tmp_path):
    image = glints(1).values[0]
    half = [write(tmp_path / f"half{i}.exr", image.astype(np.float16)) for i in range(2)]
    assert command(*half)[0] == 0
    grey = [write(tmp_path / f"grey{i}.exr", image[..., :1] * (1 + i)) for i in range(2)]
    assert command(grey[0], grey[0])[0] == 0 and command(*grey)[0] == 1
    names = ["R", "G", "B", "A", "depth.T"]
    more = np.concatenate([image, image[..., :2]], axis=-1)
    layered = write(tmp_path / "more.exr", more, pixel_format=mi.Bitmap.PixelFormat.MultiChannel, channel_names=names)
    status, out, _ = command(layered, write(tmp_path / "plain.exr", image))
    assert status == 0 and "not compared are the channels A, depth.T" in out


def test_folders_of_seeds(command, tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    for index, name in enumerate(("one", "sub/two")):
        write_seeds(a, name, glints(6, 10 + index, scene=index))
        write_seeds(b, name, glints(9, 20 + index, scene=index))
    status, out, _ = command(a, b)
    assert status == 0 and "the same: 2 of 2" in out and "sub/two: the same up to noise" in out
    wrong = glints(6, 33, scene=1)
    write_seeds(a, "sub/two", changed(wrong, wrong.values * 3))
    status, out, _ = command(a, b)
    assert status == 1 and "1 of 2 images differ" in out and "one: the same" in out and "sub/two: different" in out
    assert command(a, b, "--alpha", 1e-300)[0] == 0


def test_stored_references(command, tmp_path):
    seeds = write_seeds(tmp_path / "seeds", "one", glints(40, 1))
    assert command(seeds, "--store", tmp_path / "stored")[0] == 0
    reference = tmp_path / "stored" / "one.exr"
    kept, unused = storage.read_side([reference])
    assert isinstance(kept, Moments) and not unused
    np.testing.assert_allclose(kept.means, stored(glints(40, 1)).means, rtol=1e-6)
    np.testing.assert_allclose(kept.variances, stored(glints(40, 1)).variances, rtol=1e-6)
    assert storage.provenance_of(reference)["files"][0] == "one-seed0.exr"
    good, bad = glints(8, 5), changed(glints(8, 5), glints(8, 5).values * 2)
    assert command(write_seeds(tmp_path / "good", "one", good), tmp_path / "stored")[0] == 0
    assert command(write_seeds(tmp_path / "bad", "one", bad), tmp_path / "stored")[0] == 1
    assert command(write(tmp_path / "single.exr", bad.values[0] * 3), reference)[0] == 1
    assert command(reference, reference)[0] == 0
    assert command(reference, "--store", tmp_path / "again")[0] == 2


def broken_inputs(folder):
    """Arguments that cannot be compared, with a fragment of the answer."""
    image = glints(1).values[0]
    good = write(folder / "good.exr", image)
    (folder / "text.exr").write_text("not an image")
    (folder / "short.exr").write_bytes(good.read_bytes()[:200])
    (folder / "empty").mkdir()
    write(folder / "small.exr", image[:5])
    write(folder / "grey.exr", image[..., :1])
    layer = write(
        folder / "layer.exr",
        image,
        pixel_format=mi.Bitmap.PixelFormat.MultiChannel,
        channel_names=["x.R", "x.G", "x.B"],
    )
    two = write_seeds(folder / "two", "one", glints(2))
    write_seeds(two, "extra", glints(2))
    both = write_seeds(folder / "both", "one", glints(2))
    mixed = write_seeds(folder / "mixed", "one", glints(2))
    write(mixed / "one.exr", image)
    sizes = write_seeds(folder / "sizes", "one", glints(2))
    write(sizes / "one-seed7.exr", image[:5])
    return [
        ((good, folder / "none.exr"), "does not exist"),
        ((good, folder / "text.exr"), "is not an OpenEXR file"),
        ((folder / "text.exr", folder / "both"), "is not an OpenEXR file"),
        ((good, folder / "short.exr"), "incomplete"),
        ((good, folder / "empty"), "holds no .exr file"),
        ((good, folder / "small.exr"), "one size"),
        ((good, folder / "grey.exr"), "channels"),
        ((layer, good), "needed are R, G and B, or Y"),
        ((two, both), "lacks extra, which A has"),
        ((both, two), "lacks extra, which B has"),
        ((mixed, both), "lies beside seeds of the same name"),
        ((sizes, both), "different sizes"),
        ((good,), "B is missing"),
        ((good, "--store", folder / "s"), "two seeds or more"),
        ((good, good, "--store", folder / "s"), "leave B off"),
        ((good, good, "--alpha", 0), "not between 0 and 1"),
        ((good, good, "--block", 0), "not a positive number"),
        ((good, good, "--tolerance", -1), "not zero or more"),
        ((folder / "single.exr", folder / "single.exr"), "does not exist"),
    ]


def test_bad_input_is_answered(command, tmp_path):
    for arguments, fragment in broken_inputs(tmp_path):
        status, _, err = command(*arguments)
        assert status == 2 and fragment in err, (arguments, err)


def test_whatever_goes_wrong_is_no_difference(command, tmp_path, monkeypatch):
    """An exit status of 1 says that images differ."""
    image = write(tmp_path / "one.exr", glints(1).values[0])
    broken = mi.Bitmap(glints(1).values[0])
    broken.metadata()[storage.ATTRIBUTE] = '{"seeds": 8,'
    broken.write(str(tmp_path / "broken.exr"))
    status, _, err = command(image, tmp_path / "broken.exr")
    assert status == 2 and "broken.exr is a stored reference with a broken header" in err

    def fail(*_):
        raise ZeroDivisionError("no reason")

    monkeypatch.setattr(statistic, "compare_exactly", fail)
    assert command(image, image)[0::2] == (2, "imagediff: unexpected ZeroDivisionError: no reason\n")


def test_references_of_other_scales_are_refused():
    with pytest.raises(BadInput, match="constants"):
        compare(glints(4).moments(1.0), glints(4).moments(2.0))


class Page(html.parser.HTMLParser):
    """Counts the pictures of a page and collects what it would load."""

    def __init__(self, text):
        super().__init__()
        self.pictures, self.loaded = 0, []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            if name in ("src", "href") and not value.startswith("data:image/png;base64,"):
                self.loaded.append(value)
        self.pictures += tag == "img"


def test_page(command, tmp_path):
    """Self-contained; holds verdict, pictures, a map for each family, and the table; also for single images."""
    a, b = tmp_path / "a", tmp_path / "b"
    bright = glints(6, 3)
    write_seeds(a, "one<b>", changed(bright, bright.values * 2))
    write_seeds(b, "one<b>", glints(6, 4))
    page = tmp_path / "pages" / "difference.html"
    assert command(a, b, "--html", page)[0] == 1
    text = page.read_text(encoding="utf-8")
    found = Page(text)
    assert found.pictures == 7 and not found.loaded and "http" not in text
    for fragment in ("Image comparison: different", "one&lt;b&gt;", "brightness", "placement", "noise", "whole image"):
        assert fragment in text
    assert command(a / "one<b>-seed0.exr", b / "one<b>-seed0.exr", "--html", page)[0] == 1
    assert Page(page.read_text(encoding="utf-8")).pictures == 4
    bright.values[0, 2, 3] = np.nan
    write_seeds(a, "one<b>", bright)
    assert command(a, b, "--html", page)[0] == 1
    text = page.read_text(encoding="utf-8")
    assert Page(text).pictures == 3 and "infinite or undefined pixels: 1 in A" in text
    assert [path.name for path in page.parent.iterdir()] == ["difference.html"]


# ---- the references -------------------------------------------------------------------------------------------------


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A git repository with one commit, which the command takes for its own; nothing is rendered."""
    folder = tmp_path / "repository"
    folder.mkdir()
    monkeypatch.setattr(references, "ROOT", folder)
    monkeypatch.setattr(references, "regenerate", lambda names, out, commit: done.append((out, commit)))
    done = []
    (folder / "code.rs").write_text("let one = 1;")
    references.git("init", "--quiet")
    references.git("add", ".")
    references.git("-c", "user.name=T", "-c", "user.email=t@example.org", "commit", "--quiet", "-m", "one")
    return folder, done


@pytest.mark.parametrize("name", ["code.rs", "new.rs"])
def test_uncommitted_changes_are_refused(repository, name):
    """Before anything is rendered, naming the file; elsewhere than in `tests/images` they are noted."""
    folder, done = repository
    head = references.git("rev-parse", "HEAD")
    references.main([])
    (folder / name).write_text("let one = 2;")
    with pytest.raises(SystemExit, match=f"(?s)committed code only.*{name}"):
        references.main([])
    references.main(["--out", str(folder / "elsewhere")])
    expected = [(references.FOLDER, head), (folder / "elsewhere", f"{head} with uncommitted changes")]
    assert done == expected


def test_calibration_tables_go_between_the_marks():
    text = f"before\n{calibration.BEGIN}\nold\n{calibration.END}\nafter\n"
    once = calibration.put_between(text, "| new |")
    assert "old" not in once and "| new |" in once and once.startswith("before") and once.endswith("after\n")
    assert calibration.put_between(once, "| new |") == once


def test_calibration_measures_alarms_and_power(monkeypatch):
    """On synthetic images: p-values are spread evenly, a large change is always found, and brightness tells."""
    monkeypatch.setattr(calibration, "POOL", range(300))
    monkeypatch.setattr(calibration, "SPLITS", 10)
    monkeypatch.setattr(calibration, "POWER_SPLITS", 5)
    images, rng = glints(300, tail=1.0), np.random.default_rng(0)
    for stored_side in (True, False):
        values = calibration.false_alarms(images, rng, stored_side)
        assert len(values) == 10 and np.mean(values < 0.5) < 1 and values.min() > 1e-4
    brighter = calibration.brighter(images, 1.0)
    assert calibration.power(images, brighter, rng) == (1.0, statistic.BRIGHTNESS)
    same = calibration.others(glints(40, 77, tail=1.0), rng)
    assert calibration.power(images, same, rng)[0] < 1


def test_smallest_change_found():
    shares = {1: 0.2, 2: 0.95, 3: 0.5, 4: 0.92, 5: 1.0}
    assert calibration.smallest_found(shares, lambda change: (shares[change], "noise")) == (4, 0.92, "noise")
    assert calibration.smallest_found(shares, lambda _: (0.5, "noise")) is None
