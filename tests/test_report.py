"""The report: its data formats, and the page in a real browser, from a `file://` address, without network."""

import base64
import contextlib
import dataclasses
import io
import json
import math
import shutil
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from glints_harness import images, metrics, plan, ranks
from glints_harness.methods import METHODS
from glints_harness.reference import Reference
from glints_harness.report import animation, curves, pictures, plots, tables, text
from glints_harness.report import page as report_page
from glints_harness.report import ranks as rank_report
from glints_harness.scenes import View
from glints_harness.summary import METRICS, ErrorSplit, Estimate, Results, Summary, TemporalResult
from PIL import Image

SIDE, FRAME_SIDE = 20, 40
TILINGS = (1, 8)
FRAMES = 4
LEFT_OUT = ("glints_yan16_curved", 16)
"""A method and a sample count without a picture."""


# ---- made-up results -------------------------------------------------------------------------------------------------


def picture(seed, side=SIDE):
    """Radiance of shape (side, side, 3): a grey ramp with glints."""
    rng = np.random.default_rng(seed)
    ramp = np.linspace(0.02, 0.6, side)[None, :, None] * np.ones((side, 1, 3))
    return (ramp * rng.uniform(0.8, 1.2, (side, side, 1)) + 20 * (rng.random((side, side, 3)) > 0.97)).astype(
        np.float32
    )


class Builder:
    """Writes made-up renderings and summarises them."""

    def __init__(self, out):
        self.out = out
        self.seed = 0

    def exr(self, name, side=SIDE, invalid=False):
        """Write a picture; returns its path relative to the output folder."""
        self.seed += 1
        image = picture(self.seed, side)
        if invalid:
            image[3, 4, 1] = np.inf
        path = self.out / "runs" / f"{name}.exr"
        path.parent.mkdir(parents=True, exist_ok=True)
        mi.Bitmap(image).write(str(path))
        return path.relative_to(self.out).as_posix()

    def summary(self, tiling, method, view, spp, **changed):
        """A summary of two seeds."""
        name = f"x{tiling}-{view}-{method}-{spp}"
        rank = list(METHODS).index(method) + 1
        fields = {
            "scene": "shoes",
            "tiling": tiling,
            "surface": METHODS[method].surface,
            "method": method,
            "footprint": "sample" if METHODS[method].filters else "none",
            "view": view,
            "spp": spp,
            "time_budget": None,
            "budget_includes_build": False,
            "frame": None,
            "runs": ({},) * 2,
            "errors": errors(rank / math.sqrt(spp), method),
            "top_percent_share": 0.4,
            "seconds": Estimate(0.01 * spp * rank, 0.009 * spp * rank, 0.012 * spp * rank),
            "cpu_seconds": Estimate(0.02 * spp, 0.02 * spp, 0.02 * spp),
            "us_per_sample": Estimate(1.5 * rank, 1.4 * rank, 1.7 * rank),
            "build_seconds": 0.25 * rank if METHODS[method].plugins else None,
            "structure_bytes": 10**7 * rank if METHODS[method].plugins else None,
            "bins": 333 if method.startswith("glints_ibm") else None,
            "refinement": 1 if "yan16" in method else None,
            "nonfinite": 0,
            "image": self.exr(name, FRAME_SIDE if view == "frame" else SIDE, method == "normalmap"),
            "mean_image": self.exr(f"{name}-mean", FRAME_SIDE if view == "frame" else SIDE),
        }
        return Summary(**{**fields, **changed})

    def temporal(self, method):
        """A sequence of a method, or of the reference."""
        names = tuple(self.exr(f"sequence/{method}-{frame}") for frame in range(FRAMES))
        excess = Estimate(0.5, 0.4, 0.7)
        footprint = "none" if method == "reference" else "sample"
        excess_image = None if method == "reference" else self.exr(f"sequence/{method}-excess")
        return TemporalResult(
            "shoes", 8, method, footprint, 1, FRAMES, 0.9, excess, (30.0, 20.0, 25.0, 40.0), names, excess_image
        )


def made_ranks(folder):
    """What a benchmark of ranks wrote: two maps, two ranks and what is not compressed."""
    records, pictures = [], []
    for label in ("isotropic", "flakes"):
        for rank in (2, 16):
            params = {"map": label, "side": 64, "alpha": 0.007, "rank": rank, "scene": "bent_quad"}
            for index, name in enumerate(rank_report.QUANTITIES):
                value = (index + 1) * rank
                records.append(
                    {"name": f"tensor/{name}", "value": value, "unit": "", "ratio": value / 4, "params": params}
                )
        # Times at a further tiling, which no plot over ranks shows.
        further = {**params, "tiling": 1000}
        records.append({"name": "tensor/frame_eval_ratio", "value": 99, "unit": "", "ratio": 99, "params": further})
        for rank in (2, 16, ranks.UNCOMPRESSED):
            file = folder / "pictures" / f"{label}-{rank}.exr"
            file.parent.mkdir(parents=True, exist_ok=True)
            mi.Bitmap(picture(len(pictures))).write(str(file))
            pictures.append({"map": label, "rank": rank, "file": f"pictures/{file.name}"})
    kept = {"date": "2026-01-02", "plugins": "4567", "machine": {"processor": "Another one", "cores": 3}}
    (folder / ranks.FILE).write_text(json.dumps({"records": records, "pictures": pictures, "provenance": kept}))
    return ranks.read(folder)


def errors(size, method):
    """Made-up errors, one of them infinite."""
    value = math.inf if method == "normalmap" else size
    total = Estimate(value, value * 0.9, value * 1.2)
    split = ErrorSplit(total, Estimate(0.1, -0.1, 0.3), Estimate(0.9, 0.5, 1.3), 0.05)
    signed = ErrorSplit(Estimate(-0.01, -0.02, 0.01), Estimate(-0.01, -0.02, 0.01), Estimate(0.1, 0.05, 0.2), 0.003)
    return {metric: signed if metric == "mean_error" else split for metric in METRICS}


def scene(folder):
    """What the report asks of a scene; its map lies in `folder`."""
    mi.Bitmap(picture(0, 8)).write(str(folder / "flakes.exr"))
    crops = {"crop1": (4, 30, SIDE, SIDE), "crop2": (50, 12, SIDE, SIDE)}
    views = {"frame": View("frame", FRAME_SIDE, FRAME_SIDE, (0, 0, FRAME_SIDE, FRAME_SIDE))}
    views.update({name: View(name, 80, 80, crop) for name, crop in crops.items()})
    return SimpleNamespace(
        name="shoes",
        reduced=None,
        base_tiles=2.0,
        normal_map=folder / "flakes.exr",
        alpha=0.00707,
        texels=2048**2,
        views=lambda _size, _frame_size: views,
    )


def reference(seed, side):
    """A made-up reference."""
    mean = picture(seed, side).astype(np.float64)
    return Reference(100, mean, np.full_like(mean, 0.02), batches=5, seconds=3.0)


def rendered(tiling, view):
    """Methods that have pictures of a view: all of one crop and of the frames, few of the rest, for the tests' speed."""
    if view == "frame" or (tiling, view) == (8, "crop1"):
        return METHODS
    return () if (tiling, view) == (1, "crop2") else ("glints_ibm", "glints_direct")


def make_results(out):
    """A comparison of all methods on one scene at two tilings."""
    build = Builder(out)
    summaries, references = [], {}
    for tiling in TILINGS:
        for view in ("frame", "crop1", "crop2"):
            for seed, surface in enumerate(("texels", "rough", "interpolated")):
                side = FRAME_SIDE if view == "frame" else SIDE
                references["shoes", tiling, surface, view] = reference(1000 + seed, side)
            for method in rendered(tiling, view):
                for spp in (16,) if view == "frame" else (1, 4, 16):
                    if view == "frame" or (method, spp) != LEFT_OUT:
                        summaries.append(build.summary(tiling, method, view, spp))
    references["shoes", 1, "texels", plan.PREFILTERING] = reference(2000, SIDE)
    pixel = build.summary(8, "glints_ibm", "crop1", 1, footprint="pixel")
    left_out = {"scene": "shoes", "tiling": 8, "method": LEFT_OUT[0], "footprint": "sample", "view": "crop1"}
    left_out.update(spp=16, time_budget=None, frame=None, reason="the time limit", predicted_seconds=99.0)
    return Results(
        settings=plan.Settings(
            scenes=(scene(out),),
            methods=tuple(METHODS.values()),
            tilings=TILINGS,
            size=80,
            frame_size=FRAME_SIDE,
            unprepared={"kettle": ("glints_tensor",), "shoes": ()},
        ),
        summaries=[*summaries, pixel],
        records=[],
        references=references,
        sweep=[
            build.summary(tiling, method, "crop1", 4)
            for method in ("glints_ibm", "glints_direct")
            for tiling in (1, 2, 4)
        ],
        temporal=[build.temporal(method) for method in ("reference", "glints_ibm", "glints_unfiltered")],
        table_4={
            ("shoes", "glints_ibm", 0.01): {"bins": 400, "structure_bytes": 18 * 10**6, "build_seconds": 0.1},
            ("shoes", "glints_ibm_paper", 0.01): {"bins": 235, "structure_bytes": 36 * 10**6, "build_seconds": 0.2},
        },
        left_out=[left_out],
        provenance={
            "date": "2026-01-01T00:00:00+00:00",
            "versions": {"mitsuba": "3.9.1"},
            "plugins": "0123",
            "machine": {"processor": "A processor", "cores": 2, "memory_bytes": 2**33, "system": "A system"},
        },
        warnings={"A <strange> warning": 3},
        exposure=0.0,
        seconds=12.0,
        out=out,
        prefiltering=[
            build.summary(1, method, plan.PREFILTERING, spp, footprint="pixel")
            for method in ("glints_tensor", "glints_tensor_prefiltered")
            for spp in (1, 64)
        ],
        ranks=made_ranks(out / "bench"),
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A report of made-up results: the results and the path of the page."""
    mi.set_variant("scalar_rgb")
    results = make_results(tmp_path_factory.mktemp("report"))
    return results, report_page.write(results)


# ---- data ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mantissa", [5, 8])
def test_pixels_are_rounded_to_the_stated_precision_and_keep_their_exponent(mantissa):
    largest = np.finfo(np.float32).max
    values = np.array([0, -0.0, 1e-30, 0.1, 1, 7e4, 1e30, largest, -3, np.inf, -np.inf, np.nan], dtype=np.float32)
    values = np.concatenate([values, np.random.default_rng(1).lognormal(0, 3, 2000).astype(np.float32)])
    kept = images.rounded(values, mantissa)
    finite = np.isfinite(values)
    np.testing.assert_array_equal(np.isfinite(kept), finite)
    np.testing.assert_array_equal(kept[~finite], values[~finite])
    error = np.abs(kept[finite].astype(np.float64) - values[finite])
    bound = 2.0 ** -(mantissa + 1) * np.abs(values[finite].astype(np.float64))
    assert np.all((error <= bound) | (np.abs(values[finite]) == largest))
    assert np.any(error > 0.9 * bound)


def test_numbers_for_people():
    texts = [text.number(value) for value in (None, 0.0, 1234.0, 123456.0, 1e-7, -2.5, math.inf, math.nan)]
    assert texts == ["–", "0", "1230", "123000", "1·10⁻⁷", "−2.5", "∞", "undefined"]
    assert text.signed(0.5) == "+0.5" and text.percent(-0.123) == "−12.3 %"
    assert [text.bytes_text(size) for size in (None, 12, 35.7e6, 3.24e9)] == ["–", "12 B", "35.7 MB", "3.24 GB"]
    assert text.with_interval(Estimate(2.0, 1.5, 3.0)) == "2 [1.5, 3]"
    assert text.with_interval(Estimate(2.0, 2.0, 2.0)) == "2"


def test_tables_2_to_4_show_ours_beside_the_papers(written):
    results, _ = written
    memory = tables.table_2_or_3(results, "structure_bytes", "90×").rows[0]
    assert [(cell.text, cell.note) for cell in memory[1:4]] == [
        ("10 MB", "paper 36 MB"),
        ("20 MB", "paper 36 MB"),
        ("40 MB", "paper 3.2 GB"),
    ]
    assert [(cell.text, cell.note) for cell in memory[-2:]] == [("4×", "paper 90×"), ("2×", "paper 90×")]
    table = tables.table_4(results)
    column = [column.heading for column in table.columns].index("0.00707")
    assert [row[column].text for row in table.rows] == ["333²", "333²", "10 MB", "20 MB"]
    assert [row[1].note for row in table.rows[2:]] == ["paper 40 MB"] * 2
    column = [column.heading for column in table.columns].index("0.01")
    assert [(row[column].text, row[column].note) for row in table.rows] == [
        ("400²", "paper 235²"),
        ("235²", "paper 235²"),
        ("18 MB", "paper 36 MB"),
        ("36 MB", "paper 36 MB"),
    ]


def test_errors_at_the_references_noise_are_marked_one_by_one(written):
    """Those of the best method at 16 spp: 0.25 each, of a noise of 0.05 each, but for the relative MSE's and FLIP's."""
    results, _ = written
    item = next(s for s in results.summaries if (s.method, s.view, s.spp) == ("glints_ibm", "crop1", 16))
    noises = {"relmse": 0.13, "flip": 0.17}
    split = {name: dataclasses.replace(item.errors[name], noise=noise) for name, noise in noises.items()}
    noisy = dataclasses.replace(item, errors={**item.errors, **split})
    marked = {name for name in METRICS if "≈" in tables.error_table(results, [noisy], name).rows[0][5].text}
    assert marked == {"relmse", "flip"}


def test_mean_errors_are_shares_of_the_references_mean(written):
    results, _ = written
    item = next(s for s in results.summaries if (s.method, s.view) == ("glints_ibm_rough", "crop1"))
    mean = results.references["shoes", item.tiling, "rough", "crop1"].mean.mean()
    (row,) = tables.error_table(results, [item], "mean_error").rows
    assert row[6].text == text.percent(-0.01 / mean)


def test_what_was_left_out_everywhere_is_not_called_not_compared(written):
    """A method without a single picture of a view."""
    results, _ = written
    shown = [s for s in results.summaries if s.method != LEFT_OUT[0]]
    gallery = pictures.gallery(dataclasses.replace(results, summaries=shown), SimpleNamespace(submit=lambda *_: None))
    group = gallery.cases[1]["views"][1]["groups"][0]
    details = {entry["name"]: entry["detail"] for entry in report_page.strip(gallery, group)}
    assert details["Yan (curved)"] == "left out"


def test_excess_variance_is_shown_by_sign():
    values = np.array([[-4.0, 0.0, 4.0, 100.0, np.nan]])
    found = animation.signed_colours(animation.signed_root(np.stack([values] * 3, axis=-1)), 2.0)[0].astype(int)
    assert found[0, 2] > found[0, 0] + 50 and found[2, 0] > found[2, 2] + 50
    assert np.ptp(found[1]) < 5 and tuple(found[2]) == tuple(found[3])
    assert tuple(found[4]) == images.INVALID_COLOUR


def test_every_plot_is_there_as_svg_and_pdf(written):
    results, _ = written
    names = {path.stem for path in (results.out / "plots").glob("*.svg")}
    assert names == {path.stem for path in (results.out / "plots").glob("*.pdf")}
    expected = {
        f"shoes-x{tiling}-crop1-rmse-over-{axis}" for tiling in TILINGS for axis in ("spp", "seconds-with-build")
    }
    assert expected | {"shoes-time-over-tiling", "shoes-x8-maximum-over-frames"} <= names
    text = (results.out / "plots" / "shoes-x8-crop1-rmse-over-spp.svg").read_text(encoding="utf-8")
    assert "Inverse bin map · sample" in text and "Inverse bin map · pixel" in text and "∞" in text
    assert not list(results.out.rglob(".unfinished-*"))


def test_a_plot_lists_the_values_of_its_markers_in_their_order(tmp_path):
    points = [plots.Point(x, y, y, y, f"at {x}") for x, y in ((16, 1.0), (1, 3.0), (4, math.inf))]
    drawn = plots.draw(plots.Plot("p", "", "x", "y", (plots.Series("glints_ibm", "a", tuple(points)),)), tmp_path)
    assert drawn["points"] == {"points-0": ["at 1", "at 16"]}
    group = drawn["svg"].split('id="points-0"')[1].split("</g>")[0]
    places = [float(mark.split('"')[0]) for mark in group.split(' x="')[1:]]
    assert len(places) == 2 and places[0] < places[1]


def test_prefiltered_light_is_compared_at_most_samples_and_by_its_noise(written):
    results, path = written
    section = report_page.prefiltering(results)
    plain, prefiltered = "Tensor decomposition", "Tensor decomposition, prefiltered light"
    titles = [shot["title"] for shot in section["shots"]]
    truth = results.references["shoes", 1, "texels", plan.PREFILTERING]
    assert titles == [f"{plain} · pixel, 64 spp", f"{prefiltered} · pixel, 64 spp", f"Reference, {truth.spp} spp"]
    assert len({shot["uri"] for shot in section["shots"]}) == 3
    found = curves.prefiltering_plots(results)
    assert list(found) == ["rmse", "relmse", "noise"]
    noise = found["noise"].series[1]
    assert (noise.method, noise.label) == ("glints_tensor_prefiltered", f"{prefiltered} · pixel")
    assert [(point.x, point.y) for point in noise.points] == [(1, 0.9**0.5), (64, 0.9**0.5)]
    assert len(section["table"].rows) == 4
    text = path.read_text(encoding="utf-8")
    assert 'id="prefiltering"' in text and 'data-plot="prefiltering/noise"' in text


def test_plots_and_pictures_of_ranks_come_from_the_last_benchmark(written):
    results, path = written
    found = rank_report.rank_plots(results.ranks)
    assert list(found) == list(rank_report.QUANTITIES)
    assert [item.label for item in found["precompute"].series] == ["isotropic", "flakes"]
    assert [(point.x, point.y) for point in found["precompute"].series[0].points] == [(2, 2), (16, 16)]
    assert [(point.x, point.y) for point in found["frame_eval_ratio"].series[0].points] == [(2, 10), (16, 80)]
    # Storage is plotted as the share of what is not compressed.
    assert [(point.x, point.y) for point in found["storage"].series[1].points] == [(2, 1.0), (16, 8.0)]
    section = report_page.rank_section(results)
    assert [row["map"] for row in section["rows"]] == ["isotropic", "flakes"]
    assert [shot["title"] for shot in section["rows"][0]["shots"]] == ["rank 2", "rank 16", "not compressed"]
    assert len({shot["uri"] for row in section["rows"] for shot in row["shots"]}) == 6
    text = path.read_text(encoding="utf-8")
    assert "the plugins have changed since" in text and "Another one, 3 cores" in text
    assert 'data-plot="rank/frame_sample_ratio"' in text


def test_what_is_not_precomputed_is_named_with_the_command_that_makes_it(written):
    text = written[1].read_text(encoding="utf-8")
    assert "Tensor decomposition: Kettle" in text
    assert "./scripts/compare --scene kettle --methods glints_tensor" in text


def test_without_prefiltering_and_ranks_the_report_has_no_such_sections(written):
    results = dataclasses.replace(written[0], prefiltering=[], ranks=None)
    assert curves.prefiltering_plots(results) == {} == rank_report.rank_plots(results.ranks)
    assert report_page.prefiltering(results) is None and report_page.rank_section(results) is None


@pytest.mark.parametrize("damage", ["text", "record", "picture"])
def test_a_damaged_benchmark_of_ranks_is_named(tmp_path, damage):
    made_ranks(tmp_path)
    file = tmp_path / ranks.FILE
    kept = json.loads(file.read_text())
    if damage == "text":
        file.write_text(file.read_text()[:-9])
    elif damage == "record":
        kept["records"][0].pop("ratio")
        file.write_text(json.dumps(kept))
    else:
        (tmp_path / kept["pictures"][1]["file"]).unlink()
    with pytest.raises(ValueError, match=r"ranks\.json: .*; run scripts/bench --only tensor again"):
        ranks.read(tmp_path)
    assert ranks.read(tmp_path / "nowhere") is None


def test_the_animation_has_every_frame(written):
    results, _ = written
    with Image.open(results.out / "animations" / "shoes-x8.webp") as picture:
        assert picture.n_frames == FRAMES
        first = np.asarray(picture.convert("RGB"))
        picture.seek(1)
        assert np.any(np.asarray(picture.convert("RGB")) != first)


# ---- the page in a browser -------------------------------------------------------------------------------------------


@contextlib.contextmanager
def launched():
    """A headless Chromium, if this machine has one."""
    sync_api = pytest.importorskip("playwright.sync_api")
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        pytest.skip("no Chromium on this machine: the report was not opened in a browser")
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def browser():
    """One browser for all of these tests."""
    with launched() as chromium:
        yield chromium


@contextlib.contextmanager
def opened(browser, path, width, height, **options):
    """A page on the report; complaints of the browser and requests that leave the file are errors."""
    context = browser.new_context(viewport={"width": width, "height": height}, **options)
    page = context.new_page()
    problems = []
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("request", lambda request: problems.append(request.url) if is_foreign(request.url, path) else None)
    page.goto(path.as_uri())
    page.wait_for_function("document.querySelector('#stage-label').textContent !== ''")
    yield page
    context.close()
    assert not problems


def test_a_request_to_the_network_would_be_noticed(browser, written, tmp_path):
    path = tmp_path / "index.html"
    text = written[1].read_text(encoding="utf-8")
    path.write_text(text.replace("<main>", '<main><img src="http://127.0.0.1:9/picture.png">'), encoding="utf-8")
    with pytest.raises(AssertionError, match="picture.png"), opened(browser, path, 400, 400):
        pass


def test_a_comparison_of_one_method_and_one_seed_has_a_page_too(browser, tmp_path):
    results = make_results(tmp_path)
    one = [item for item in results.summaries if (item.method, item.view, item.spp) == ("normalmap", "crop1", 1)]
    unknown = {metric: ErrorSplit(Estimate(1.0, 1.0, 1.0), None, None, 0.1) for metric in METRICS}
    results.summaries = [dataclasses.replace(item, runs=item.runs[:1], errors=unknown) for item in one]
    results.settings = dataclasses.replace(results.settings, methods=(METHODS["normalmap"],))
    results.references = {key: kept for key, kept in results.references.items() if key[2:] == ("texels", "crop1")}
    results.sweep, results.temporal, results.left_out, results.warnings = [], [], [], {}
    results.prefiltering = []
    with opened(browser, report_page.write(results), 800, 600) as page:
        assert page.locator("#stage-label").inner_text() == "Reference · texels"
        page.evaluate("choose({ case: 1, pinned: 0 })")
        assert page.locator("#stage-label").inner_text() == "Stock normalmap"
        assert page.locator("#sweep").count() == 0


def is_foreign(url, path):
    """Whether a page at `path` asks for something that is not in it."""
    return url != path.as_uri() and not url.startswith(("data:", "blob:"))


@pytest.fixture
def page(browser, written):
    """The report on a wide window, scrolled to the viewer on the first crop."""
    with opened(browser, written[1], 1280, 900) as found:
        found.evaluate("choose({ case: 1, view: 1, group: 0 }); element('viewer-body').scrollIntoView()")
        settle(found)
        yield found


def settle(page):
    """Wait until the viewer has drawn what it was told to draw."""
    page.wait_for_function("onScreen && wall.children.length > 0")
    page.evaluate("redraw()")
    page.wait_for_timeout(50)


def pixels(page, selector="#stage"):
    """A canvas of the page as an array (height, width, 3)."""
    data = page.eval_on_selector(selector, "canvas => canvas.toDataURL('image/png').split(',')[1]")
    with Image.open(io.BytesIO(base64.b64decode(data))) as picture:
        return np.asarray(picture.convert("RGB"))


def middles(canvas, count):
    """Colours at the middles of `count` by `count` equal squares of a canvas."""
    rows, columns = (((np.arange(count) + 0.5) / count * size).astype(int) for size in canvas.shape[:2])
    return canvas[np.ix_(rows, columns)]


def test_the_browser_decodes_the_very_pixels_that_were_packed(page, written):
    results, _ = written
    found = page.evaluate(
        "(async () => [currentShot().data, Array.from(new Uint32Array((await currentShot().pixels()).buffer))])()"
    )
    item = next(s for s in results.summaries if (s.tiling, s.view, s.spp) == (8, "crop1", 1))
    expected = images.rounded(images.read_exr(results.out / item.image), pictures.CROP_MANTISSA)
    np.testing.assert_array_equal(np.array(found[1], dtype=np.uint32).view(np.float32), expected.ravel())


def test_keys_flip_between_methods_and_reference(page):
    label = page.locator("#stage-label")
    first = pixels(page)
    assert label.inner_text() == "Inverse bin map · footprint: sample"
    page.keyboard.press("4")
    settle(page)
    fourth = pixels(page)
    assert "flat" in label.inner_text() and np.any(fourth != first)
    for _ in range(3):
        page.keyboard.press("ArrowLeft")
    settle(page)
    np.testing.assert_array_equal(pixels(page), first)
    page.keyboard.press("r")
    settle(page)
    assert label.inner_text() == "Reference · texels" and np.any(pixels(page) != first)
    page.keyboard.press("r")
    settle(page)
    np.testing.assert_array_equal(pixels(page), first)


def test_pointing_at_a_picture_puts_it_on_the_stage(page):
    page.locator(".tile").nth(5).hover()
    settle(page)
    assert page.locator("#stage-label").inner_text().startswith("Direct sum")
    page.mouse.move(5, 5)
    settle(page)
    assert page.locator("#stage-label").inner_text().startswith("Inverse bin map")


def test_the_exposure_slider_changes_every_picture(page):
    before, small = pixels(page).astype(int), pixels(page, ".tile:nth-child(2) canvas").astype(int)
    page.locator(".slider input").last.fill("2")
    settle(page)
    assert page.locator(".slider output").all_inner_texts() == ["+2 stops"] * 2
    after = pixels(page).astype(int)
    assert np.all(after >= before) and after.mean() > before.mean() + 20
    assert pixels(page, ".tile:nth-child(2) canvas").mean() > small.mean()
    # 0.1 at +2 stops is 0.4, which is 170 in sRGB.
    assert page.evaluate("paintTones(Float32Array.of(0.1, 0.1, 0.1), 2)[0]") == pytest.approx(170, abs=1)


def test_zoom_and_pan_move_all_pictures_alike(page):
    box = page.locator("#stage").bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.3, box["y"] + box["height"] * 0.3)
    before = pixels(page)
    page.mouse.wheel(0, -600)
    page.mouse.move(5, 5)
    settle(page)
    assert page.evaluate("viewer.zoom") == pytest.approx(SIDE / 6)
    page.evaluate("moveWindow(2, [0.4, 0.4])")
    settle(page)
    stage, tile = pixels(page), pixels(page, ".tile:nth-child(1) canvas")
    assert np.any(stage != before)
    np.testing.assert_array_equal(middles(stage, SIDE // 2), middles(tile, SIDE // 2))
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 160, box["y"] + 100)
    page.mouse.up()
    assert page.evaluate("viewer.centre[0]") < 0.39


def test_two_fingers_zoom(browser, written):
    with opened(browser, written[1], 360, 740, has_touch=True) as page:
        page.evaluate("stage.scrollIntoView()")
        settle(page)
        box = page.locator("#stage").bounding_box()
        y = box["y"] + box["height"] / 2
        touch = page.context.new_cdp_session(page)
        for kind, spread in (("touchStart", 20), ("touchMove", 40), ("touchMove", 60), ("touchEnd", None)):
            ends = (
                [] if spread is None else [{"x": 180 - spread, "y": y, "id": 0}, {"x": 180 + spread, "y": y, "id": 1}]
            )
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": ends})
        assert page.evaluate("viewer.zoom") == pytest.approx(3, rel=0.05)


def test_the_readout_gives_the_value_under_the_pointer(page, written):
    results, _ = written
    box = page.locator("#stage").bounding_box()
    page.mouse.move(box["x"] + box["width"] * 7.5 / SIDE, box["y"] + box["height"] * 2.5 / SIDE)
    page.wait_for_function("element('readout').textContent.startsWith('(7, 2)')")
    text = page.locator("#readout").inner_text()
    item = next(s for s in results.summaries if (s.tiling, s.view, s.spp) == (8, "crop1", 1))
    value = images.read_exr(results.out / item.image)[2, 7]
    truth = results.references["shoes", 8, "texels", "crop1"].mean[2, 7]
    assert [float(word) for word in text.split(")")[1].split()[:3]] == pytest.approx(value, rel=0.01)
    assert [float(word) for word in text.split("reference ")[1].split()[:3]] == pytest.approx(truth, rel=0.01)
    error = np.mean((value - truth) ** 2 / (truth**2 + 0.01))
    found = float(text.split("relative squared error ")[1].split()[0])
    assert found == pytest.approx(error, rel=0.05, abs=1e-3)


def test_invalid_pixels_are_magenta_and_counted(page):
    label = page.locator("#stage-label")
    for _ in METHODS:
        if label.inner_text() == "Stock normalmap":
            break
        page.keyboard.press("ArrowRight")
        settle(page)
    assert label.inner_text() == "Stock normalmap"
    assert "1 invalid pixel" in page.locator("#stage-detail").inner_text()
    stage = pixels(page)
    y, x = int(stage.shape[0] * 3.5 / SIDE), int(stage.shape[1] * 4.5 / SIDE)
    assert tuple(stage[y, x]) == images.INVALID_COLOUR
    page.evaluate("viewer.mode = 'relative'")
    settle(page)
    assert tuple(pixels(page)[y, x]) == images.INVALID_COLOUR


def test_error_maps_show_errors_against_the_methods_own_surface(page, written):
    results, _ = written
    page.keyboard.press("3")
    found = page.evaluate("(async () => Array.from(await MODES.signed.numbers(currentShot())))()")
    item = next(
        s for s in results.summaries if (s.tiling, s.view, s.spp, s.method) == (8, "crop1", 1, "glints_ibm_rough")
    )
    image = images.read_exr(results.out / item.image)
    truth = results.references["shoes", 8, "rough", "crop1"].mean
    expected = np.mean((image - truth) / np.sqrt(truth**2 + 0.01), axis=-1)
    np.testing.assert_allclose(np.array(found).reshape(SIDE, SIDE), expected, rtol=0.02, atol=0.02)
    settle(page)
    plain = pixels(page)
    page.get_by_role("button", name="HDR-FLIP", exact=True).first.click()
    settle(page)
    assert np.any(pixels(page) != plain) and page.locator("#scale").is_visible()
    flip = page.evaluate("(async () => Array.from(await currentShot().flipMap()))()")
    assert np.mean(flip) == pytest.approx(metrics.flip(image, truth), abs=0.01)


def test_plots_show_values_on_hover_and_follow_the_metric(page):
    holder = page.locator(".plot[data-crop='shoes-x1/crop1']")
    holder.scroll_into_view_if_needed()
    page.wait_for_selector(".plot[data-crop='shoes-x1/crop1'] svg")
    page.wait_for_timeout(100)
    marker = holder.locator('[data-points="points-0"] use').first.bounding_box()
    page.mouse.move(marker["x"] + marker["width"] / 2 + 3, marker["y"] + marker["height"] / 2)
    tip = page.locator("#tip").inner_text()
    assert (
        tip.startswith("Inverse bin map · sample\n1\u00a0spp, 2 seeds\nRMSE 1 [0.9, 1.2]") and "preprocessing" in tip
    )
    page.get_by_role("button", name="SMAPE", exact=True).click()
    page.wait_for_function(
        "document.querySelector(\"[data-crop='shoes-x1/crop1'] svg\").textContent.includes('SMAPE')"
    )
    assert page.locator("[data-metric=rmse]").first.is_hidden()
    assert page.locator("[data-metric=smape]").first.is_visible()


@pytest.mark.parametrize(("width", "height", "scheme"), [(1280, 900, "light"), (360, 740, "dark")])
def test_the_page_fits_wide_and_narrow_windows(browser, written, tmp_path, width, height, scheme):
    with opened(browser, written[1], width, height, color_scheme=scheme) as page:
        sizes = page.evaluate("[document.documentElement.scrollWidth, document.body.scrollHeight]")
        assert sizes[0] == width
        for step in range(3):
            page.evaluate(f"window.scrollTo(0, {step * height})")
            page.wait_for_timeout(200)
            shot = tmp_path / f"{width}-{step}.png"
            page.screenshot(path=shot)
            with Image.open(shot) as picture:
                colours = np.asarray(picture.convert("RGB"))
            assert colours.shape == (height, width, 3)
            assert colours.std() > 10
            assert (colours.mean() > 128) == (scheme == "light")


def test_the_page_holds_all_methods_and_leaves_nothing_unsaid(written):
    _, path = written
    text = path.read_text(encoding="utf-8")
    index = json.loads(text.split('id="index">')[1].split("</script>")[0])
    shown = {shot["method"] for shot in index["shots"]}
    assert shown == {*METHODS, "reference"}
    assert "A &lt;strange&gt; warning" in text and "the time limit" in text
    assert 'src="http' not in text and "url(" not in text
