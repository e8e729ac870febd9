"""Tells whether two renderings are the same up to Monte Carlo noise: a test for images with heavy-tailed pixels.

Problem
    A and B are images of the same pixels, each rendered with several independent seeds. Pixels of glinting surfaces
    have heavy tails: one sample in thousands is hundreds of times brighter than the mean. A normal test for every
    pixel then rejects equal images, and a threshold on a difference image is either blind or always red.

Hypotheses
    H0: the images of A and of B are draws of one distribution. H1: they are not, because the images differ in
    brightness, in where they are bright, or in how noisy they are. (`means_only` tests less: whether the expected
    images are equal.)

Features of a pixel of seed i
    brightness  R_i, G_i, B_i    linear radiance, one feature for each channel
    placement   g_i = y_i / (c + |y_i|)  with y the mean of the channels and c a power of two near the mean of y over
                the image: bounded by one, so that faint glints count as much as bright ones, and no firefly decides
    noise       d_i = n / (n - 1) (g_i - mean_j g_j)^2  for n seeds, whose mean is the unbiased variance of g.
                Comparing means of squared deviations is Levene's test of equal variances (Levene 1960). A lost
                filter shows here.

Statistic
    Each feature is averaged over a block of pixels first, x_i for seed i: the central limit theorem works on the
    block's pixels times the seeds. For the means x_A, x_B of n_A, n_B seeds and the variances s_A^2, s_B^2 over them,

        t = (x_A - x_B) / (s sqrt(1 / m_A + 1 / m_B)),   s^2 = ((n_A - 1) s_A^2 + (n_B - 1) s_B^2) / (n_A + n_B - 2)

    has Student's distribution with n_A + n_B - 2 degrees of freedom. The variance is pooled, as H0 allows: in skewed
    data mean and variance of a few seeds are correlated, which spoils a test that trusts the variance of the smaller
    side alone (Welch's). m = n, but m = n - 1 for the noise: the deviations share their mean, and the variance of a
    variance of n normal numbers is 2 sigma^4 / (n - 1). `means_only` takes the brightness alone and Welch's t, as the
    variances may differ then. A side of one seed is allowed if the other has more; the noise is left out.

    Every feature is tested on each block and once on the whole image, which sees small changes of everything. The
    smallest p-value of m tests (all features, blocks and images of one call) is corrected by Sidak:
    p' = 1 - (1 - p)^m. Correlated tests, like the channels of one pixel, make that conservative. The images differ if
    p' < alpha.

What is assumed
    Seeds are independent. Where one side is a stored reference (mean and variance per pixel), the variance of its
    blocks is taken as the sum of its pixels', so its pixels have to be independent: rendered with a box filter and an
    independent sampler. Images of single seeds need no such assumption. Rounding errors are no difference: the
    standard error is never taken below `ROUNDING`.

Measured false alarms and the smallest changes that are found: docs/image-tests.md; `./scripts/references --calibrate`
measures them anew.
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats

ALPHA = 1e-3
"""Probability that equal images are called different, over all tests of a call."""

BLOCK = 8
"""Pixels a side of a block: small enough to see a glint misplaced by a few pixels."""

ROUNDING = 1e-6
"""Relative difference that single precision explains, a few times its resolution. Squared for the noise, a square."""

BRIGHTNESS, PLACEMENT, NOISE = "brightness", "placement", "noise"
FAMILIES = (BRIGHTNESS, PLACEMENT, NOISE)


class BadInput(ValueError):
    """Images that cannot be compared; the message says why and what to do."""


def family(feature):
    """What a feature tells: placement, noise, or the brightness of a channel."""
    return feature if feature in (PLACEMENT, NOISE) else BRIGHTNESS


@dataclass(frozen=True)
class Seeds:
    """Images of independent seeds."""

    values: np.ndarray
    """Shape (seeds, height, width, channels), linear radiance."""
    channels: tuple
    """Names of the channels, such as ("R", "G", "B")."""

    @property
    def count(self):
        """Number of seeds."""
        return len(self.values)

    @property
    def shape(self):
        """(height, width) in pixels."""
        return self.values.shape[1:3]

    @property
    def mean(self):
        """The mean image, shape (height, width, channels)."""
        return self.values.mean(axis=0, dtype=np.float64)

    @property
    def nonfinite(self):
        """Number of pixels, over all seeds, with an infinite or undefined channel."""
        return int(np.count_nonzero(~np.isfinite(self.values).all(axis=-1)))

    def features(self, scale):
        """Pairs of a feature's name and its values, shape (seeds, height, width). One seed alone has no noise."""
        for index, name in enumerate(self.channels):
            yield name, self.values[..., index].astype(np.float64)
        grey = self.values.mean(axis=-1, dtype=np.float64)
        compressed = grey / (scale + np.abs(grey))
        yield PLACEMENT, compressed
        if self.count > 1:
            yield NOISE, (compressed - compressed.mean(axis=0)) ** 2 * (self.count / (self.count - 1))

    def blocks(self, scale, grid):
        """`BlockMoments` on a grid of blocks."""
        found = [(name, block_sums(pixels, grid) / grid.pixels) for name, pixels in self.features(scale)]
        means = np.stack([blocks.mean(axis=0) for _, blocks in found], axis=-1)
        variances = np.zeros_like(means)
        if self.count > 1:
            variances = np.stack([blocks.var(axis=0, ddof=1) for _, blocks in found], axis=-1)
        return BlockMoments(tuple(name for name, _ in found), means, variances, self.count)

    def moments(self, scale):
        """What a stored reference keeps of these images."""
        found = [(name, pixels.mean(axis=0), pixels.var(axis=0, ddof=1)) for name, pixels in self.features(scale)]
        names, means, variances = zip(*found)
        return Moments(names, np.stack(means, axis=-1), np.stack(variances, axis=-1), self.count, scale)


@dataclass(frozen=True)
class Moments:
    """A stored reference: mean and variance of every feature of every pixel over the seeds."""

    names: tuple
    """Names of the features: the channels, then placement and noise."""
    means: np.ndarray
    """Shape (height, width, features)."""
    variances: np.ndarray
    """Of one seed, unbiased; the same shape."""
    count: int
    """Number of seeds, at least two."""
    scale: float
    """The c of the placement."""

    @property
    def channels(self):
        """Names of the channels."""
        return tuple(name for name in self.names if family(name) == BRIGHTNESS)

    @property
    def shape(self):
        """(height, width) in pixels."""
        return self.means.shape[:2]

    @property
    def mean(self):
        """The mean image, shape (height, width, channels)."""
        return self.means[..., : len(self.channels)]

    @property
    def nonfinite(self):
        """Number of pixels with an infinite or undefined mean or variance."""
        finite = np.isfinite(self.means) & np.isfinite(self.variances)
        return int(np.count_nonzero(~finite.all(axis=-1)))

    def blocks(self, _scale, grid):
        """`BlockMoments` on a grid of blocks of independent pixels."""
        means, variances = (
            np.moveaxis(block_sums(np.moveaxis(item, -1, 0), grid), 0, -1) for item in (self.means, self.variances)
        )
        pixels = grid.pixels[..., None]
        return BlockMoments(self.names, means / pixels, variances / pixels**2, self.count)


@dataclass(frozen=True)
class BlockMoments:
    """Mean over the seeds, and variance of one seed, of features' block means: arrays (rows, columns, features)."""

    names: tuple
    means: np.ndarray
    variances: np.ndarray
    count: int

    def pick(self, names):
        """The same with these features only."""
        index = [self.names.index(name) for name in names]
        return BlockMoments(tuple(names), self.means[..., index], self.variances[..., index], self.count)


class Grid:
    """Blocks of about `block` by `block` pixels over an image; the last of a row or column also takes what is left."""

    def __init__(self, shape, block):
        """`shape` is (height, width) in pixels; `block` None makes one block of the whole image."""
        self.rows, self.columns = (self.edges(size, block or size) for size in shape)
        self.pixels = np.outer(np.diff(self.rows), np.diff(self.columns))

    @staticmethod
    def edges(size, block):
        """Borders of the blocks along one side, from 0 to `size`."""
        return np.append(np.arange(max(1, size // block)) * block, size)

    def place(self, row, column):
        """A block's pixels, for people."""
        left, right = self.columns[column : column + 2]
        top, bottom = self.rows[row : row + 2]
        return f"x {left} to {right - 1}, y {top} to {bottom - 1}"


def block_sums(images, grid):
    """Sums over the blocks: (images, height, width) to (images, rows, columns)."""
    return np.add.reduceat(np.add.reduceat(images, grid.rows[:-1], axis=1), grid.columns[:-1], axis=2)


@dataclass(frozen=True)
class FeatureTest:
    """One feature on the blocks of one grid; arrays of shape (rows, columns)."""

    feature: str
    grid: Grid
    mean_a: np.ndarray
    mean_b: np.ndarray
    t: np.ndarray
    p: np.ndarray
    """Two-sided, not corrected."""


@dataclass(frozen=True)
class Finding:
    """The most conspicuous block of a feature."""

    feature: str
    place: str
    mean_a: float
    mean_b: float
    t: float
    p: float
    """Corrected for all tests of the call."""


@dataclass(frozen=True)
class Side:
    """What a report shows of one side of a comparison."""

    mean: np.ndarray
    """The mean image, shape (height, width, channels)."""
    seeds: int
    nonfinite: int
    """Number of pixels, over all seeds, with an infinite or undefined channel."""

    @classmethod
    def of(cls, side):
        """The side of `Seeds` or `Moments`."""
        with np.errstate(invalid="ignore"):
            return cls(side.mean, side.count, side.nonfinite)


@dataclass(frozen=True)
class Comparison:
    """All tests of one pair of images."""

    a: Side
    b: Side
    tests: tuple
    """`FeatureTest` of every feature on blocks and on the whole image; empty where pixels are not finite."""
    family_size: int = 0
    """Number of tests to correct for; more than this pair's own if it is one of several."""
    alpha: float = ALPHA

    @property
    def own_size(self):
        """Number of this pair's tests."""
        return sum(test.p.size for test in self.tests)

    def corrected(self, p):
        """Sidak's correction of p-values."""
        return sidak(p, self.family_size or self.own_size)

    @property
    def p(self):
        """The smallest p-value, corrected; None without tests."""
        return float(self.corrected(min(test.p.min() for test in self.tests))) if self.tests else None

    def family_p(self, name):
        """The smallest p-value of a family of features, corrected; None if it was not tested."""
        found = [test.p.min() for test in self.tests if family(test.feature) == name]
        return float(self.corrected(min(found))) if found else None

    @property
    def different(self):
        """The verdict. Pixels that are not finite have no distribution to be compared, and are never the same."""
        return not self.tests or self.p < self.alpha

    def findings(self):
        """The most conspicuous block of each feature on each grid, the smallest p-value first."""
        return sorted((self.finding(test) for test in self.tests), key=lambda item: (item.p, -abs(item.t)))

    def finding(self, test):
        """The most conspicuous block of one feature."""
        order = np.lexsort((-np.abs(test.t).ravel(), test.p.ravel()))
        row, column = np.unravel_index(order[0], test.t.shape)
        place = test.grid.place(row, column) if test.t.size > 1 else "the whole image"
        numbers = (item[row, column] for item in (test.mean_a, test.mean_b, test.t, self.corrected(test.p)))
        return Finding(test.feature, place, *map(float, numbers))


def compare(a, b, block=BLOCK, means_only=False, alpha=ALPHA):
    """Compare two sides, each `Seeds` or `Moments`, of which at least one has two seeds; returns a `Comparison`."""
    check(a, b)
    if a.nonfinite or b.nonfinite:
        return Comparison(Side.of(a), Side.of(b), (), alpha=alpha)
    scale = common_scale(a, b)
    grids = [Grid(a.shape, block), Grid(a.shape, None)]
    if grids[0].pixels.size == 1:
        grids.pop()
    tests = [
        test
        for grid in grids
        for test in feature_tests(a.blocks(scale, grid), b.blocks(scale, grid), grid, means_only)
    ]
    return Comparison(Side.of(a), Side.of(b), tuple(tests), alpha=alpha)


def check(a, b):
    """Refuse sides that cannot be compared."""
    if a.shape != b.shape:
        (height_a, width_a), (height_b, width_b) = a.shape, b.shape
        raise BadInput(f"A has {width_a} x {height_a} pixels, B {width_b} x {height_b}; render both at one size")
    if a.channels != b.channels:
        raise BadInput(f"A has the channels {', '.join(a.channels)}, B {', '.join(b.channels)}; both need the same")
    if max(a.count, b.count) < 2:
        raise BadInput("neither side has two seeds, so there is no variance to test with; compare them exactly")


def common_scale(a, b):
    """The c of the placement: that of a stored reference, else the power of two nearest to the mean of both sides."""
    stored = {side.scale for side in (a, b) if isinstance(side, Moments)}
    if len(stored) > 1:
        raise BadInput(
            f"the two references compress radiance with different constants ({min(stored):g} and {max(stored):g}); "
            "compare seeds with one of them instead"
        )
    return stored.pop() if stored else compression_scale((a.mean.mean() + b.mean.mean()) / 2)


def compression_scale(mean):
    """The power of two nearest to a mean radiance; 1 for black images."""
    return float(2.0 ** np.round(np.log2(abs(mean)))) if mean != 0 else 1.0


def feature_tests(a, b, grid, means_only):
    """`FeatureTest` of each feature that both sides have."""
    names = [name for name in a.names if name in b.names and not (means_only and family(name) != BRIGHTNESS)]
    a, b = a.pick(names), b.pick(names)
    error, freedom = welch_error(a, b) if means_only else pooled_error(a, b)
    error = np.hypot(error, rounding_error(a, b))
    # Where nothing varies and nothing differs (black on both sides), 0 / 0 is no difference.
    difference = a.means - b.means
    t = np.divide(difference, error, out=np.zeros_like(difference), where=difference != 0)
    p = 2 * stats.t.sf(np.abs(t), freedom)
    arrays = (np.moveaxis(item, -1, 0) for item in (a.means, b.means, t, p))
    return [FeatureTest(name, grid, *items) for name, *items in zip(names, *arrays)]


def effective_count(side):
    """The m of the statistic, for each feature: the number of seeds, one fewer for the noise."""
    return np.array([side.count - (name == NOISE) for name in side.names])


def pooled_error(a, b):
    """Standard error of the difference under H0, and the degrees of freedom."""
    freedom = a.count + b.count - 2
    variance = ((a.count - 1) * a.variances + (b.count - 1) * b.variances) / freedom
    return np.sqrt(variance * (1 / effective_count(a) + 1 / effective_count(b))), freedom


def welch_error(a, b):
    """Standard error of the difference with unequal variances, and Welch's degrees of freedom."""
    if min(a.count, b.count) < 2:
        raise BadInput("images of different noise need at least two seeds on both sides")
    of_a, of_b = a.variances / a.count, b.variances / b.count
    total = of_a + of_b
    spread = of_a**2 / (a.count - 1) + of_b**2 / (b.count - 1)
    least = float(min(a.count, b.count) - 1)
    return np.sqrt(total), np.divide(total**2, spread, out=np.full_like(total, least), where=spread > 0)


def rounding_error(a, b):
    """Differences of the means that rounding explains: relative for radiance, absolute for the bounded features."""
    size = np.maximum(np.abs(a.means), np.abs(b.means))
    bounded = {PLACEMENT: ROUNDING, NOISE: ROUNDING**2}
    return np.stack(
        [bounded.get(name, ROUNDING * size[..., i]) * np.ones(size.shape[:2]) for i, name in enumerate(a.names)], -1
    )


def sidak(p, count):
    """The probability that the smallest of `count` independent p-values is at most `p`, under H0."""
    with np.errstate(divide="ignore"):
        return -np.expm1(count * np.log1p(-np.asarray(p, dtype=np.float64)))


def together(comparisons):
    """Several comparisons as one call: each corrected for the tests of all, so that alpha is the level of all."""
    total = sum(item.own_size for item in comparisons)
    return [Comparison(item.a, item.b, item.tests, total, item.alpha) for item in comparisons]


@dataclass(frozen=True)
class ExactComparison:
    """Two single images, value by value."""

    a: Side
    b: Side
    tolerance: float
    differing: np.ndarray
    """Whether a pixel differs in some channel by more than the tolerance; shape (height, width)."""

    @property
    def different(self):
        """The verdict."""
        return bool(self.differing.any())

    @property
    def largest(self):
        """Largest absolute difference, in radiance; of the finite values."""
        with np.errstate(invalid="ignore"):
            difference = np.abs(self.a.mean - self.b.mean)
        return float(np.max(difference, initial=0.0, where=np.isfinite(difference)))


def compare_exactly(a, b, tolerance=ROUNDING):
    """Compare two single images: equal where |a - b| <= tolerance max(|a|, |b|), or both the same infinity or NaN."""
    if a.shape != b.shape or a.channels != b.channels:
        check(a, b)
    x, y = a.values[0].astype(np.float64), b.values[0].astype(np.float64)
    with np.errstate(invalid="ignore"):
        near = np.abs(x - y) <= tolerance * np.maximum(np.abs(x), np.abs(y))
    finite = np.isfinite(x) & np.isfinite(y)
    same = np.where(finite, near, (x == y) | (np.isnan(x) & np.isnan(y)))
    return ExactComparison(Side.of(a), Side.of(b), tolerance, ~same.all(axis=-1))
