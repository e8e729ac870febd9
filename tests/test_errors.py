"""Every bad input ends in an error that names the plugin, the parameter and the file, and says what to do."""

import importlib
import pathlib
import re
import subprocess
import sys

import mitsuba as mi
import mitsuba_glints
import numpy as np
import pytest
from support import BSDFS, bsdf, random_normals


def message_of(load):
    with pytest.raises(RuntimeError) as error:
        load()
    return str(error.value)


def assert_mentions(message, *fragments):
    for fragment in fragments:
        assert fragment in message, f"{fragment!r} is missing in: {message}"


# ---- files ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plugin", BSDFS)
def test_filename_is_required(plugin):
    assert_mentions(message_of(lambda: mi.load_dict({"type": plugin})), plugin, '"filename"', "missing", "EXR")


@pytest.mark.parametrize("plugin", BSDFS)
def test_missing_file(plugin, tmp_path):
    path = str(tmp_path / "nowhere.exr")
    assert_mentions(message_of(lambda: bsdf(plugin, path)), plugin, "filename", path, "check the path")


@pytest.mark.parametrize("name", ["broken.exr", "broken.png", "broken.jpg", "broken.tif", "no_extension"])
def test_broken_file(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"\x89PNG\r\n\x1a\n and then nothing" if name == "broken.png" else b"not an image at all")
    assert_mentions(
        message_of(lambda: bsdf("glints_ibm", path)), "glints_ibm", "filename", str(path), "EXR, PNG, JPEG or TIFF"
    )


def test_truncated_file(make_map):
    path = make_map(random_normals(32, 32, 0.2))
    content = pathlib.Path(path).read_bytes()
    pathlib.Path(path).write_bytes(content[: len(content) // 2])
    assert_mentions(message_of(lambda: bsdf("glints_ibm", path)), "glints_ibm", "filename", path)


@pytest.mark.parametrize("name, dtype", [("grey.exr", np.float32), ("grey.png", np.uint8)])
def test_grey_image(name, dtype, tmp_path):
    path = str(tmp_path / name)
    mi.Bitmap(np.ones((4, 4, 1), dtype)).write(path)
    message = message_of(lambda: bsdf("glints_ibm", path))
    assert_mentions(message, "glints_ibm", "filename", path, "red, green and blue")


@pytest.mark.parametrize(
    "normal, problem",
    [
        ((np.nan, 0, 1), "finite"),
        ((np.inf, 0, 1), "finite"),
        ((0, 0, 0), "no length"),
        ((1, 0, -0.5), "out of the surface"),
    ],
)
def test_bad_normal(make_map, normal, problem):
    normals = random_normals(5, 4, 0.1)
    normals[2, 3] = normal
    path = make_map(normals)
    message = message_of(lambda: bsdf("glints_direct", path, encoding="signed"))
    assert_mentions(message, "glints_direct", "filename", path, "column 3, row 2", problem)


# ---- parameters -----------------------------------------------------------------------------------------------------

BAD_PARAMETERS = [
    # Conflicts are refused by name.
    ({"material": "Cu", "eta": 1.0}, ["material", "eta", "exclude"]),
    ({"material": "Cu", "k": 1.0}, ["material", "k", "exclude"]),
    ({"material": "none", "eta": 1.0, "k": 1.0}, ["material", "eta", "exclude"]),
    ({"material": "Cu", "int_ior": 1.5}, ["material", "int_ior", "exclude"]),
    ({"eta": 1.0, "k": 1.0, "ext_ior": 1.5}, ["eta", "ext_ior", "exclude"]),
    ({"masking": "none", "masking_alpha_u": 0.1, "masking_alpha_v": 0.1}, ["masking", "masking_alpha_u", "exclude"]),
    # Pairs.
    ({"eta": 1.0}, ["eta", "k", "missing"]),
    ({"k": 1.0}, ["eta", "k", "missing"]),
    ({"masking_alpha_u": 0.1}, ["masking_alpha_u", "masking_alpha_v", "missing"]),
    ({"masking_alpha_v": 0.1}, ["masking_alpha_u", "masking_alpha_v", "missing"]),
    # Unknown names: the message lists the known ones.
    ({"encoding": "octahedral"}, ["encoding", "octahedral", "auto", "unsigned", "signed"]),
    ({"normalization": "none"}, ["normalization", "projected", "paper"]),
    ({"masking": "ggx"}, ["masking", "ggx", "none", "beckmann"]),
    ({"material": "Unobtainium"}, ["material", "Unobtainium", "none", "Cu"]),
    ({"int_ior": "unobtainium"}, ["int_ior", "unobtainium", "bk7"]),
    # Domains.
    ({"alpha": 0.0}, ["alpha", "0.0001"]),
    ({"alpha": 2.0}, ["alpha", "0.0001"]),
    ({"alpha": float("nan")}, ["alpha", "0.0001"]),
    ({"tiles": 0.0}, ["tiles", "positive"]),
    ({"tiles": -1.0}, ["tiles", "positive"]),
    ({"tiles": float("inf")}, ["tiles", "finite"]),
    ({"masking_alpha_u": -0.1, "masking_alpha_v": 0.1}, ["masking_alpha_u", "-0.1"]),
    ({"int_ior": -1.5}, ["int_ior", "positive"]),
    ({"int_ior": 1.5, "ext_ior": 1.5}, ["int_ior", "ext_ior", "differ"]),
    # Types.
    ({"alpha": "rough"}, ["alpha", "float", "string"]),
    ({"flip_y": 3}, ["flip_y", "boolean"]),
    ({"specular_reflectance": "red"}, ["specular_reflectance"]),
    # Misspelled.
    ({"alpah": 0.1}, ["alpah"]),
    ({"alpha_u": 0.1}, ["alpha_u"]),
]


@pytest.mark.parametrize("parameters, fragments", BAD_PARAMETERS, ids=[str(p) for p, _ in BAD_PARAMETERS])
def test_bad_parameter(rough_map, parameters, fragments):
    message = message_of(lambda: bsdf("glints_unfiltered", rough_map, **parameters))
    assert_mentions(message, "glints_unfiltered", *fragments)


def test_bad_transform(rough_map):
    to_uv = mi.ScalarTransform3f().scale((float("nan"), 1))
    assert_mentions(message_of(lambda: bsdf("glints_ibm", rough_map, to_uv=to_uv)), "glints_ibm", "to_uv", "finite")


@pytest.mark.parametrize("name", ["bins", "leaf_size"])
@pytest.mark.parametrize("number", [-1, 10**12, 1.5, "many"])
def test_bad_structure_parameter(rough_map, name, number):
    assert_mentions(message_of(lambda: bsdf("glints_ibm", rough_map, **{name: number})), "glints_ibm", name)


@pytest.mark.parametrize("plugin", ["glints_yan16", "glints_direct", "glints_unfiltered"])
@pytest.mark.parametrize("name", ["bins", "leaf_size"])
def test_structure_parameters_belong_to_one_plugin(rough_map, plugin, name):
    assert_mentions(message_of(lambda: bsdf(plugin, rough_map, **{name: 4})), plugin, name)


@pytest.mark.parametrize(
    "parameters, fragments",
    [
        ({"alpha": 0.1, "intrinsic": 0.1}, ["alpha", "intrinsic", "exclude"]),
        ({"intrinsic": 0.0}, ["intrinsic", "0.7071"]),
        ({"alpha": 5e-5}, ["alpha", "0.0001"]),
        ({"intrinsic": 1.0}, ["intrinsic", "0.7071"]),
        ({"elements": "round"}, ["elements", "flat", "curved"]),
        ({"refinement": 2}, ["refinement"]),
        ({"elements": "curved", "refinement": 17}, ["refinement", "1 to 16"]),
        ({"elements": "curved", "refinement": -1}, ["refinement"]),
        ({"footprint_sigma": 0.0}, ["footprint_sigma", "0.05"]),
        ({"footprint_sigma": float("nan")}, ["footprint_sigma", "0.05"]),
        ({"normalization": "paper"}, ["normalization", "projected area"]),
    ],
    ids=str,
)
def test_bad_parameter_of_position_normal_mixtures(rough_map, parameters, fragments):
    assert_mentions(message_of(lambda: bsdf("glints_yan16", rough_map, **parameters)), "glints_yan16", *fragments)


def test_bad_interpolation(rough_map):
    message = message_of(lambda: bsdf("glints_unfiltered", rough_map, interpolation="cubic"))
    assert_mentions(message, "glints_unfiltered", "interpolation", "nearest", "bilinear")


@pytest.mark.parametrize("footprint", [-1.0, float("nan"), float("inf"), "pixels", "", "1 px", "-2"])
def test_bad_footprint_of_the_integrator(footprint):
    message = message_of(lambda: mi.load_dict({"type": "glints_path", "footprint": footprint}))
    assert_mentions(message, "glints_path", '"footprint"', '"sample"', '"pixel"', "number of pixels")


# ---- variants and versions ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plugin", BSDFS + ("glints_path",))
def test_other_variant(plugin, rough_map):
    mi.set_variant("llvm_ad_rgb")
    scene = {"type": plugin} if plugin == "glints_path" else {"type": plugin, "filename": rough_map}
    message = message_of(lambda: mi.load_dict(scene))
    assert_mentions(message, plugin, "scalar_rgb", "scalar_spectral", "scalar_spectral_polarized")


def test_other_version_of_mitsuba(monkeypatch):
    monkeypatch.setattr(mi, "__version__", "3.8.0")
    with pytest.raises(ImportError) as error:
        importlib.reload(mitsuba_glints)
    assert_mentions(str(error.value), "3.8.0", mitsuba_glints.MITSUBA_VERSION, "pip install")


def test_source_folder_instead_of_the_installed_package():
    sources = pathlib.Path(__file__).parents[1] / "cpp" / "mitsuba"
    command = [sys.executable, "-c", "import mitsuba_glints"]
    result = subprocess.run(command, cwd=sources, capture_output=True, text=True, timeout=60, check=False)
    assert_mentions(result.stderr, "ImportError", str(sources), "pip install")


def test_the_version_is_pinned_once():
    """pyproject.toml cannot read the pin from the package, so it has to agree."""
    text = (pathlib.Path(__file__).parents[1] / "pyproject.toml").read_text()
    pins = re.findall(r"mitsuba==([0-9.]+)", text)
    assert pins and set(pins) == {mitsuba_glints.MITSUBA_VERSION}


@pytest.mark.parametrize(
    "order",
    ["mi.set_variant('scalar_rgb'); import mitsuba_glints", "import mitsuba_glints; mi.set_variant('scalar_rgb')"],
)
def test_import_before_or_after_the_variant(order, tmp_path):
    script = f"import mitsuba as mi; {order}; print(mi.load_dict({{'type': 'glints_path'}}))"
    result = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert "GlintsPath" in result.stdout, result.stderr
