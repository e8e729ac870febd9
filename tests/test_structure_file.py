"""`structure_file` of `glints_ibm`: what `glints precompute` saved, through the loaded plugin."""

import pathlib
import shutil
import subprocess

import mitsuba as mi
import numpy as np
import pytest
import support
from test_errors import assert_mentions, message_of

TOOL = pathlib.Path(__file__).resolve().parents[1] / "scripts" / "glints"
SIDE = 64


def precompute(normal_map, output, *options):
    command = [TOOL, "precompute", "ibm", normal_map, "-o", output, *options]
    subprocess.run(list(map(str, command)), check=True, capture_output=True, timeout=600)
    return str(output)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A map with shadowing, another one of the same size, and structures: of rough and sharp flakes, and interpolated."""
    folder = tmp_path_factory.mktemp("structures")
    for name, seed in (("map.exr", 1), ("other.exr", 2)):
        support.write_exr(folder / name, support.random_normals(SIDE, SIDE, 0.5, seed))
    normal_map = folder / "map.exr"
    precompute(normal_map, folder / "rough.glints", "--alpha", "0.1", "--distribution", "ggx")
    precompute(normal_map, folder / "sharp.glints", "--alpha", "0.004")
    precompute(
        normal_map, folder / "bilinear.glints", "--alpha", "0.1", "--interpolation", "bilinear", "--refinement", "2"
    )
    return folder


ROUGH = {"alpha": 0.1, "distribution": "ggx"}
SHARP = {"alpha": 0.004}
BILINEAR = {"alpha": 0.1, "interpolation": "bilinear", "refinement": 2}
CASES = [("rough", ROUGH), ("sharp", SHARP), ("bilinear", BILINEAR)]


def load(folder, name, **parameters):
    return mi.load_dict({"type": "glints_ibm", "structure_file": str(folder / name), **parameters})


def image(material):
    integrator = {"type": "glints_path", "max_depth": 2}
    return np.array(mi.render(support.plane_scene(material, integrator, resolution=8, samples=16), seed=3))


@pytest.mark.parametrize("name, parameters", CASES)
def test_images_are_those_of_the_built_structure_bit_for_bit(folder, name, parameters):
    built = support.bsdf("glints_ibm", folder / "map.exr", **parameters)
    # What agrees with the file may be said, all or nothing of it.
    for given in ({}, parameters):
        loaded = load(folder, f"{name}.glints", filename=str(folder / "map.exr"), **given)
        assert np.array_equal(image(loaded), image(built))
    assert_mentions(str(loaded), f"{name}.glints", f"resolution = {SIDE} x {SIDE}")
    # The twin: other flakes.
    other = support.bsdf("glints_ibm", folder / "map.exr", **{**parameters, "alpha": 0.11})
    assert not np.array_equal(image(other), image(built))


def test_a_file_can_be_seen_through_a_gaussian(folder):
    gaussian = {"footprint_filter": "gaussian", "footprint_sigma": 0.4}
    built = support.bsdf("glints_ibm", folder / "map.exr", **ROUGH, **gaussian)
    loaded = load(folder, "rough.glints", filename=str(folder / "map.exr"), **gaussian)
    assert np.array_equal(image(loaded), image(built))
    # The twin: the box.
    assert not np.array_equal(image(load(folder, "rough.glints", filename=str(folder / "map.exr"))), image(built))


@pytest.mark.parametrize("name, parameters", CASES)
def test_one_file_is_enough(folder, name, parameters):
    """Bit for bit, shadowing by the map's slopes included, which the file has."""
    images = {}
    for masking in ("none", "beckmann"):
        images[masking] = image(support.bsdf("glints_ibm", folder / "map.exr", masking=masking, **parameters))
        for given in ({}, parameters):
            loaded = load(folder, f"{name}.glints", masking=masking, **given)
            assert np.array_equal(image(loaded), images[masking])
    assert_mentions(str(loaded), f"{name}.glints", f"resolution = {SIDE} x {SIDE}")
    # The twin: without shadowing the image is another one.
    assert np.abs(images["none"] - images["beckmann"]).max() > 1e-3 * images["none"].mean()


def test_the_log_tells_that_nothing_was_built(folder):
    with support.captured_log(mi.LogLevel.Info) as lines:
        load(folder, "sharp.glints")
        support.bsdf("glints_ibm", folder / "map.exr")
    (line,) = (line for line in lines if "sharp.glints" in line)
    assert_mentions(line, "64 x 64", "loaded in")
    # A map is built from, and that is said before it may take long.
    first, last = (line for line in lines if "map.exr" in line)
    assert "building" in first and "built in" in last


# ---- what does not agree --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "parameters, fragments",
    [
        ({"alpha": 0.2}, ['"alpha"', "0.1", "--alpha 0.2"]),
        ({"alpha": 0.0}, ['"alpha"', "mirrors"]),
        ({"distribution": "beckmann"}, ['"distribution"', "ggx", "--distribution beckmann"]),
        ({"normalization": "paper"}, ['"normalization"', "projected"]),
        ({"structure": "paper"}, ['"structure"', "compact"]),
        ({"bins": 31}, ['"bins"', "compact"]),
        ({"leaf_size": 4}, ['"leaf_size"', "compact"]),
        ({"binning": "projected"}, ['"binning"', "compact"]),
        ({"encoding": "signed"}, ['"encoding"', '"filename"']),
        ({"flip_y": True}, ['"flip_y"', '"filename"']),
    ],
    ids=str,
)
def test_conflicts_are_refused_by_name(folder, parameters, fragments):
    message = message_of(lambda: load(folder, "rough.glints", **parameters))
    assert_mentions(message, "glints_ibm", "structure_file", "leave", *fragments)


def test_the_compact_structure_may_be_named(folder):
    load(folder, "rough.glints", structure="compact")


@pytest.mark.parametrize(
    "name, parameters, fragments",
    [
        ("rough", {"interpolation": "bilinear"}, ['"interpolation"', "nearest"]),
        ("bilinear", {"interpolation": "nearest"}, ['"interpolation"', "bilinear"]),
        ("bilinear", {"interpolation": "bilinear", "refinement": 4}, ['"refinement"', "4", "for, 2"]),
    ],
)
def test_interpolation_must_agree(folder, name, parameters, fragments):
    for given in ({}, {"filename": str(folder / "map.exr")}):
        message = message_of(lambda given=given: load(folder, f"{name}.glints", **given, **parameters))
        assert_mentions(message, "glints_ibm", "structure_file", f"{name}.glints", *fragments)


def test_the_map_must_be_the_one_in_the_file(folder, make_map):
    smaller = make_map(support.random_normals(48, 64, 0.2))
    normals = np.array(mi.Bitmap(str(folder / "map.exr")))[..., :3]
    one_texel = normals.copy()
    # By less than what the structure keeps of a normal.
    one_texel[40, 7, 0] += 1e-6
    for name in ("sharp", "bilinear"):
        for filename, fragments in (
            (folder / "other.exr", ["checksum", "encoding", "glints precompute"]),
            (smaller, ["48 x 64", "64 x 64"]),
            (make_map(one_texel, "one.exr"), ["checksum"]),
        ):
            message = message_of(lambda name=name, file=filename: load(folder, f"{name}.glints", filename=str(file)))
            assert_mentions(message, "glints_ibm", '"filename"', str(filename), f"{name}.glints", *fragments)
        load(folder, f"{name}.glints", filename=make_map(normals, "same.exr"))
    message = message_of(lambda: load(folder, "sharp.glints", filename=str(folder / "map.exr"), flip_y=True))
    assert_mentions(message, "glints_ibm", '"filename"', "sharp.glints")


# ---- files ----------------------------------------------------------------------------------------------------------


def damaged(folder, tmp_path, change):
    path = tmp_path / "damaged.glints"
    content = bytearray((folder / "rough.glints").read_bytes())
    path.write_bytes(change(content))
    return path


def flipped(at):
    def change(content):
        content[at] ^= 0x10
        return content

    return change


@pytest.mark.parametrize(
    "change, fragments",
    [
        (lambda content: content[: len(content) // 2], ["bytes instead of", "glints precompute"]),
        (lambda content: content[:10], ["cut off", "glints precompute"]),
        (lambda content: b"", ["empty", "glints precompute"]),
        (lambda content: content + b"\0", ["bytes instead of"]),
        (flipped(-100), ["damaged", "glints precompute"]),
        (flipped(40), ["damaged", "glints precompute"]),
        (flipped(12), ["version", "glints precompute"]),
        (lambda content: b"\x89PNG\r\n\x1a\n" + content[8:], ["not a saved structure", "glints precompute"]),
    ],
    ids=["half", "ten bytes", "nothing", "longer", "body", "header", "version", "another kind"],
)
def test_damaged_files(folder, tmp_path, change, fragments):
    path = damaged(folder, tmp_path, change)
    message = message_of(lambda: load(tmp_path, path.name))
    assert_mentions(message, "glints_ibm", '"structure_file"', str(path), *fragments)


def test_missing_files_and_folders(folder, tmp_path):
    message = message_of(lambda: load(tmp_path, "nowhere.glints"))
    assert_mentions(message, "glints_ibm", '"structure_file"', "nowhere.glints", "check its name")
    assert_mentions(message_of(lambda: load(tmp_path, ".")), "glints_ibm", '"structure_file"', "not a regular file")
    swapped = str(folder / "rough.glints")
    message = message_of(lambda: support.bsdf("glints_ibm", swapped))
    assert_mentions(message, "glints_ibm", "filename", swapped)


def test_a_loaded_file_may_be_replaced(folder, tmp_path):
    """As `glints precompute --force` does: who has mapped it keeps what was in it."""
    path = tmp_path / "map.glints"
    shutil.copy(folder / "rough.glints", path)
    bsdf = load(tmp_path, "map.glints")
    before = image(bsdf)
    precompute(folder / "other.exr", path, "--alpha", "0.2", "--force")
    assert np.array_equal(image(bsdf), before)
    assert not np.array_equal(image(load(tmp_path, "map.glints")), before)


def test_other_plugins_have_no_structure_file(folder):
    for plugin in ("glints_direct", "glints_carpaint"):
        message = message_of(
            lambda plugin=plugin: support.bsdf(plugin, folder / "map.exr", structure_file=str(folder / "rough.glints"))
        )
        assert_mentions(message, plugin, "structure_file")
