"""The BSDF plugins as Mitsuba sees them: texels, footprints, colours, consistency. Their filters have tests elsewhere."""

import math
import pathlib
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import mitsuba_glints
import numpy as np
import pytest
from glints_harness import timer
from support import (
    BSDFS,
    FILTERED,
    NEEDS_DIFFERENTIALS,
    bsdf,
    captured_log,
    interaction,
    plane_scene,
    random_direction,
    random_normals,
    unit,
    value,
)

REPOSITORY = pathlib.Path(__file__).parents[1]


def test_selftest_of_the_installed_package():
    script = REPOSITORY / "cpp" / "mitsuba" / "selftest.py"
    subprocess.run([sys.executable, str(script), mitsuba_glints.plugin_dir()], check=True, timeout=60)


def test_command_line(rough_map, tmp_path):
    """`mitsuba -a FOLDER`, for people who start Mitsuba otherwise."""
    scene = f"""<scene version="3.0.0">
        <integrator type="glints_path"><string name="footprint" value="pixel"/></integrator>
        <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film></sensor>
        <shape type="sphere"><point name="center" x="0" y="0" z="4"/>
            <bsdf type="glints_ibm"><string name="filename" value="{rough_map}"/><integer name="tiles" value="2"/></bsdf></shape>
        <emitter type="constant"/>
    </scene>"""
    (tmp_path / "scene.xml").write_text(scene)
    entry = "from mitsuba.cli import _main; import sys; sys.argv[0] = 'mitsuba'; sys.exit(_main())"
    result = subprocess.run(
        [
            sys.executable,
            "-c",
            entry,
            "-m",
            "scalar_rgb",
            "-a",
            mitsuba_glints.plugin_dir(),
            "-o",
            "out.exr",
            "scene.xml",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (tmp_path / "out.exr").exists(), result.stdout + result.stderr
    assert np.isfinite(np.array(mi.Bitmap(str(tmp_path / "out.exr")))).all()


# ---- texels ---------------------------------------------------------------------------------------------------------


def peak(normal, alpha, wi):
    """`eval` of one flake at its own normal, wi = wo = n: D(0) / (4 (t.n) (i.n)) with D(0) = 1 / (pi alpha^2)."""
    return 1 / (math.pi * alpha**2) / (4 * normal[2] * wi[2])


def texel_uvs(rng, count):
    """Random points of several periods, and points on and next to the boundaries of texels."""
    uvs = rng.uniform(-3, 3, size=(count, 2))
    boundaries = rng.integers(-21, 21, size=(count, 2)) / np.array([7, 5])
    nudged = np.nextafter(boundaries.astype(np.float32), rng.choice([-9, 9], size=boundaries.shape).astype(np.float32))
    return np.concatenate([uvs, boundaries, nudged]).astype(np.float32)


@pytest.mark.parametrize(
    "transform",
    [
        None,
        mi.ScalarTransform3f().scale((3.7, -2.1)),
        mi.ScalarTransform3f().translate((0.31, -7.2)).rotate(33).scale((1.3, 0.4)),
    ],
    ids=["identity", "scale", "affine"],
)
def test_texels_are_those_of_bitmap(make_map, transform):
    """The flake found at a uv is the texel that Mitsuba's own `bitmap` finds: on its normal the lobe has its peak.

    With alpha = 0.001 any other of the 35 normals (slopes around 0.3) would give zero.
    """
    alpha = 1e-3
    path = make_map(random_normals(7, 5, 0.3, seed=5))
    extra = {} if transform is None else {"to_uv": transform}
    bitmap = mi.load_dict(
        {
            "type": "bitmap",
            "filename": path,
            "raw": True,
            "filter_type": "nearest",
            "wrap_mode": "repeat",
            "format": "variant",
            **extra,
        }
    )
    glints = bsdf("glints_unfiltered", path, alpha=alpha, masking="none", **extra)
    for uv in texel_uvs(np.random.default_rng(1), 60):
        si = interaction(uv=uv)
        normal = np.array(bitmap.eval_3(si), dtype=np.float64)
        si.wi = mi.ScalarVector3f(*normal)
        assert value(glints, si, normal) == pytest.approx(peak(unit(normal), alpha, normal), rel=1e-3), uv


@pytest.mark.parametrize("plugin", BSDFS)
@pytest.mark.parametrize("size", [(1, 1), (1, 6), (7, 3), (64, 2)])
def test_any_size(make_map, plugin, size):
    """Maps of one texel or of different sides: the texel in the last column and row, one period further."""
    width, height = size
    normals = random_normals(width, height, 0.2, seed=3)
    normal = unit(normals[height - 1, width - 1])
    if plugin == "glints_yan16":
        normals[:] = normal  # it blends neighbours also without a footprint
    glints = bsdf(plugin, make_map(normals), alpha=0.01, masking="none", encoding="signed")
    uv = (1 + (width - 0.5) / width, (height - 0.5) / height - 1)
    si = interaction(uv=uv, wi=normal)
    expected = peak(normal, 0.01, normal)
    tolerance = 1e-3
    if plugin == "glints_ibm":
        tolerance = 0.6  # it shows the lobe in the resolution of its bins
    elif plugin == "glints_yan16":
        expected *= normal[2]  # its lobes are round in the projected disk, Beckmann's about their normals
        tolerance = 0.01
    assert value(glints, si, normal) == pytest.approx(expected, rel=tolerance)


def test_flip_y_negates_green(make_map):
    normals = random_normals(8, 8, 0.2)
    flipped = normals * np.array([1, -1, 1], np.float32)
    a = bsdf("glints_direct", make_map(normals, "a.exr"), alpha=0.1, flip_y=True)
    b = bsdf("glints_direct", make_map(flipped, "b.exr"), alpha=0.1)
    si = interaction(duv_dx=(0.3, 0), duv_dy=(0, 0.4), wi=(0.1, 0.2, 1))
    wo = unit((0.1, -0.1, 1))
    assert value(a, si, wo) > 0
    assert value(a, si, wo) == value(b, si, wo)


def test_encodings_of_integer_and_float_files(make_map, tmp_path):
    """The same map as 16-bit PNG (unsigned), as unsigned EXR (all components positive) and as signed EXR."""
    normals = random_normals(8, 8, 0.2)
    unsigned = (normals + 1) / 2
    png = str(tmp_path / "map.png")
    mi.Bitmap((unsigned * 65535 + 0.5).astype(np.uint16)).write(png)
    maps = [make_map(normals, "signed.exr"), make_map(unsigned, "unsigned.exr"), png]
    si, wo = interaction(duv_dx=(0.3, 0), duv_dy=(0, 0.4)), unit((0.1, -0.1, 1))
    values = [value(bsdf("glints_direct", path, alpha=0.1), si, wo) for path in maps]
    assert values[0] > 0
    assert values == pytest.approx([values[0]] * 3, rel=2e-3)


# ---- footprints -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plugin", FILTERED)
def test_tiles_and_to_uv_transform_the_footprint(rough_map, plugin):
    """`tiles` and `to_uv` do to centre and partials what a caller would do by hand."""
    tiles, to_uv = 3.0, mi.ScalarTransform3f().translate((0.2, 0.1)).rotate(25).scale((2, 0.5))
    matrix = np.array(to_uv.matrix)[:2]
    plain = bsdf(plugin, rough_map, alpha=0.05)
    placed = bsdf(plugin, rough_map, alpha=0.05, tiles=tiles, to_uv=to_uv)
    uv, dx, dy = np.array([0.4, 0.7]), np.array([0.04, 0.01]), np.array([-0.02, 0.05])
    wi, wo = (0.2, -0.1, 1), unit((-0.1, 0.2, 1))
    given = interaction(uv, wi, dx, dy)
    by_hand = interaction(tiles * (matrix @ [*uv, 1]), wi, tiles * matrix[:, :2] @ dx, tiles * matrix[:, :2] @ dy)
    assert value(placed, given, wo) == pytest.approx(value(plain, by_hand, wo), rel=1e-3)
    # The broken twin: a footprint that is not transformed.
    twin = interaction(tiles * (matrix @ [*uv, 1]), wi, dx, dy)
    assert value(placed, given, wo) != pytest.approx(value(plain, twin, wo), rel=1e-2)


def test_footprint_is_the_parallelogram_of_the_partials(rough_map):
    """`glints_direct` is the mean of `glints_unfiltered` over uv + s duv_dx + t duv_dy, |s|, |t| <= 1/2.

    A footprint of about 5 x 4 texels, by 100 x 100 points; the sum is exact up to a percent.
    """
    direct, unfiltered = (bsdf(plugin, rough_map, alpha=0.2) for plugin in ("glints_direct", "glints_unfiltered"))
    uv, dx, dy = np.array([0.63, 0.21]), np.array([0.1, 0.02]), np.array([-0.03, 0.12])
    wi, wo = (0.2, -0.1, 1), unit((-0.3, 0.1, 1))
    steps = (np.arange(100) + 0.5) / 100 - 0.5
    points = [value(unfiltered, interaction(uv + s * dx + t * dy, wi), wo) for s in steps for t in steps]
    assert value(direct, interaction(uv, wi, dx, dy), wo) == pytest.approx(np.mean(points), rel=0.01)
    # The broken twin: two partials exchanged.
    twin = value(direct, interaction(uv, wi, (dx[0], dy[0]), (dx[1], dy[1])), wo)
    assert twin != pytest.approx(np.mean(points), rel=0.03)


@pytest.mark.parametrize("plugin", BSDFS)
def test_any_footprint_is_answered(rough_map, plugin):
    """Degenerate, huge, thin and invalid footprints give finite values and valid samples."""
    glints = bsdf(plugin, rough_map, alpha=0.05)
    nan, inf = float("nan"), float("inf")
    rng = np.random.default_rng(0)
    partials = [
        (0, 0, 0, 0),
        (0.1, 0, 0, 0),
        (1e-30, 0, 0, 1e-30),
        (100, 0, 0, 100),
        (1e30, 1, 1, 1e30),
        (3, 3, 3.0001, 3),
        (nan, 0, 0, 1),
        (inf, 0, 0, 1),
    ]
    for dux, dvx, duy, dvy in partials:
        for uv in [(0.3, 0.2), (-1e7, 1e7), (inf, nan)]:
            si = interaction(uv, random_direction(rng), (dux, dvx), (duy, dvy))
            for _ in range(5):
                wo = random_direction(rng)
                spectrum, pdf = glints.eval_pdf(mi.BSDFContext(), si, mi.Vector3f(*wo))
                assert math.isfinite(spectrum[0]) and math.isfinite(pdf) and spectrum[0] >= 0 and pdf >= 0
                sample, weight = glints.sample(mi.BSDFContext(), si, rng.random(), (rng.random(), rng.random()))
                assert math.isfinite(weight[0]) and math.isfinite(sample.pdf)


# ---- the contract of a BSDF -----------------------------------------------------------------------------------------


@pytest.fixture(
    params=[(plugin, width) for plugin in FILTERED for width in (0.0, 0.02, 0.3, 5.0)] + [("glints_unfiltered", 0.1)],
    ids=str,
)
def case(request, rough_map):
    plugin, width = request.param
    return bsdf(plugin, rough_map, alpha=0.05, material="Al"), width


def queries(width, count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        si = interaction(rng.random(2), random_direction(rng), (width, 0), (0, width))
        yield si, rng.random(), (rng.random(), rng.random())


def test_sample_weight_is_value_over_density(case):
    glints, width = case
    context, valid = mi.BSDFContext(), 0
    for si, u1, u2 in queries(width, 300):
        sample, weight = glints.sample(context, si, u1, u2)
        if weight[0] == 0:
            continue
        valid += 1
        assert sample.wo[2] > 0 and sample.pdf > 0 and sample.eta == 1
        assert sample.sampled_type == mi.BSDFFlags.GlossyReflection and sample.sampled_component == 0
        assert np.linalg.norm(sample.wo) == pytest.approx(1, abs=1e-5)
        assert glints.pdf(context, si, sample.wo) == pytest.approx(sample.pdf, rel=1e-4)
        expected = np.array(glints.eval(context, si, sample.wo)) / sample.pdf
        assert np.array(weight) == pytest.approx(expected, rel=1e-4)
        spectrum, pdf = glints.eval_pdf(context, si, sample.wo)
        assert pdf == pytest.approx(sample.pdf, rel=1e-4)
        assert np.array(spectrum) == pytest.approx(expected * sample.pdf, rel=1e-4)
    assert valid > 100


def test_reciprocity(case):
    """f(wi, wo) = f(wo, wi), at pairs that lobes reflect into each other; `eval` holds the cosine of wo."""
    glints, width = case
    context, compared = mi.BSDFContext(), 0
    for si, u1, u2 in queries(width, 200, seed=1):
        sample, weight = glints.sample(context, si, u1, u2)
        if weight[0] == 0 or min(sample.wo[2], si.wi[2]) < 0.05:
            continue
        there = glints.eval(context, si, sample.wo)[0] / sample.wo[2]
        swapped = interaction(si.uv, sample.wo, si.duv_dx, si.duv_dy)
        back = glints.eval(context, swapped, si.wi)[0] / si.wi[2]
        assert there == pytest.approx(back, rel=2e-3)
        compared += 1
    assert compared > 50


def test_below_the_horizon_is_black(case):
    glints, width = case
    context = mi.BSDFContext()
    up, down = mi.Vector3f(0, 0, 1), mi.Vector3f(*unit((0.1, 0, -1)))
    above, below = (
        interaction(duv_dx=(width, 0), duv_dy=(0, width)),
        interaction(wi=(0.1, 0, -1), duv_dx=(width, 0), duv_dy=(0, width)),
    )
    assert glints.eval(context, above, down)[0] == 0 and glints.pdf(context, above, down) == 0
    assert glints.eval(context, below, up)[0] == 0 and glints.pdf(context, below, up) == 0
    assert glints.sample(context, below, 0.5, (0.5, 0.5))[1][0] == 0
    diffuse_only = mi.BSDFContext()
    diffuse_only.type_mask = mi.BSDFFlags.DiffuseReflection
    assert glints.eval(diffuse_only, above, up)[0] == 0


@pytest.mark.parametrize("plugin", BSDFS)
def test_flags(rough_map, plugin):
    flags = (
        mi.BSDFFlags.GlossyReflection
        | mi.BSDFFlags.FrontSide
        | mi.BSDFFlags.SpatiallyVarying
        | mi.BSDFFlags.Anisotropic
    )
    if plugin in FILTERED:
        flags |= NEEDS_DIFFERENTIALS
    glints = bsdf(plugin, rough_map, alpha=0.5)
    assert glints.component_count() == 1
    assert glints.flags() == flags and glints.flags(0) == flags
    twosided = mi.load_dict({"type": "twosided", "material": glints})
    assert twosided.needs_differentials() == (plugin in FILTERED)
    below = interaction(wi=(0, 0, -1), duv_dx=(1, 0), duv_dy=(0, 1))
    assert value(twosided, below, (0, 0, -1)) > 0


def test_description_and_log(rough_map):
    with captured_log(mi.LogLevel.Info) as lines:
        glints = bsdf("glints_ibm", rough_map, alpha=0.04, structure="paper")
    for fragment in (rough_map, "48 x 32", "bins = 59", "structure_bytes", "build_seconds"):
        assert fragment in str(glints)
    assert any("48 x 32" in line and "built in" in line for line in lines)


# ---- Fresnel and colour ---------------------------------------------------------------------------------------------


def reflectance(rough_map, wi, wo, **parameters):
    """Ratio of `eval` with and without the given Fresnel and colour parameters."""
    si = interaction(wi=wi, duv_dx=(2, 0), duv_dy=(0, 2))
    context, wo = mi.BSDFContext(), mi.Vector3f(*unit(wo))
    coloured = bsdf("glints_direct", rough_map, alpha=0.1, **parameters).eval(context, si, wo)
    white = bsdf("glints_direct", rough_map, alpha=0.1).eval(context, si, wo)
    assert white[0] > 0
    return np.array(coloured) / np.array(white)


def cos_to_half_vector(wi, wo):
    return float(unit(wi) @ unit(unit(wi) + unit(wo)))


def unbounded_rgb(colour):
    return {"type": "srgb", "color": mi.ScalarColor3d(*map(float, colour)), "unbounded": True}


WI, WO = (0.8, 0.1, 1), (-0.9, -0.2, 1)


@pytest.mark.parametrize("material", ["Cu", "Au", "Al"])
def test_conductor(rough_map, material):
    """`material` reads Mitsuba's tables as `roughconductor` does, and F is taken at the half vector."""
    stock = mi.traverse(mi.load_dict({"type": "roughconductor", "material": material}))
    eta, k = np.array(stock["eta.value"]), np.array(stock["k.value"])
    cos = cos_to_half_vector(WI, WO)
    expected = [mi.fresnel_conductor(cos, dr.scalar.Complex2f(float(e), float(kk))) for e, kk in zip(eta, k)]
    assert reflectance(rough_map, WI, WO, material=material) == pytest.approx(expected, rel=1e-4)
    by_number = reflectance(rough_map, WI, WO, eta=unbounded_rgb(eta), k=unbounded_rgb(k))
    assert by_number == pytest.approx(expected, rel=1e-4)


def test_dielectric(rough_map):
    cos = cos_to_half_vector(WI, WO)
    for parameters, eta in [
        ({"int_ior": 1.8, "ext_ior": 1.2}, 1.5),
        ({"int_ior": "diamond"}, 2.419 / 1.000277),
        ({"ext_ior": 2}, 1.5046 / 2),
    ]:
        expected = mi.fresnel(cos, eta)[0]
        assert reflectance(rough_map, WI, WO, **parameters) == pytest.approx([expected] * 3, rel=1e-4)


def test_no_fresnel_by_default(rough_map):
    assert reflectance(rough_map, WI, WO, material="none") == pytest.approx([1, 1, 1])


def test_textured_reflectance(rough_map, tmp_path):
    """`specular_reflectance` is a texture of the surface's uv, not of the map's."""
    colours = np.array([[[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], [[0.7, 0.8, 0.9], [1, 0, 0.5]]], np.float32)
    path = str(tmp_path / "colours.exr")
    mi.Bitmap(colours).write(path)
    texture = {"type": "bitmap", "filename": path, "filter_type": "nearest", "raw": True}
    coloured = bsdf("glints_direct", rough_map, alpha=0.3, specular_reflectance=texture, tiles=3.0)
    white = bsdf("glints_direct", rough_map, alpha=0.3, tiles=3.0)
    up = mi.Vector3f(0, 0, 1)
    for row, column in np.ndindex(2, 2):
        si = interaction(uv=((column + 0.5) / 2, (row + 0.5) / 2), duv_dx=(0.1, 0), duv_dy=(0, 0.1))
        ratio = np.array(coloured.eval(mi.BSDFContext(), si, up)) / np.array(white.eval(mi.BSDFContext(), si, up))
        assert ratio == pytest.approx(colours[row, column], rel=1e-3)


def test_parameters_can_be_changed(rough_map):
    glints = bsdf("glints_direct", rough_map, alpha=0.1, material="Cu", specular_reflectance=0.5)
    parameters = mi.traverse(glints)
    names = list(parameters.keys())
    assert {name.split(".")[0] for name in names} == {"specular_reflectance", "eta", "k"}
    si, up = interaction(duv_dx=(2, 0), duv_dy=(0, 2)), (0, 0, 1)
    before = value(glints, si, up)
    parameters["specular_reflectance.value"] = 1.0
    parameters.update()
    assert value(glints, si, up) == pytest.approx(2 * before, rel=1e-5)


def test_polarized_variant_depolarises(rough_map):
    mi.set_variant("scalar_spectral_polarized")
    glints = bsdf("glints_direct", rough_map, alpha=0.1, material="Cu")
    si = interaction(wi=WI, duv_dx=(2, 0), duv_dy=(0, 2))
    si.wavelengths = (450, 520, 580, 650)
    mueller = glints.eval(mi.BSDFContext(), si, mi.Vector3f(*unit(WO)))
    for row, column in np.ndindex(4, 4):
        entry = np.array(mueller[row, column])
        assert (entry > 0).all() if row == column == 0 else (entry == 0).all()


def test_masking(make_map):
    """`beckmann` lowers grazing reflection by the Smith term of the map's own slopes; both alphas set it by hand."""
    slope = 0.3  # standard deviation along u; the map is flat along v
    normals = random_normals(64, 64, slope, seed=2)
    normals[..., 1] = 0
    path = make_map(unit(normals))

    def g1(direction, alpha_u, alpha_v):  # Walter et al. 2007
        x, y, z = unit(direction)
        a2 = ((alpha_u * x) ** 2 + (alpha_v * y) ** 2) / z**2
        a = 1 / math.sqrt(a2) if a2 > 0 else math.inf
        return 1 if a >= 1.6 else (3.535 * a + 2.181 * a * a) / (1 + 2.276 * a + 2.577 * a * a)

    plain = bsdf("glints_direct", path, alpha=0.2, masking="none")
    for wi, wo in [((1.6, 0.1, 1), (-1.2, 0, 1)), ((0.1, 1.6, 1), (0, -1.2, 1))]:
        si = interaction(wi=wi, duv_dx=(1, 0), duv_dy=(0, 1))
        for parameters, alphas in [
            ({}, (math.sqrt(2) * slope, 0)),
            ({"masking_alpha_u": 0.7, "masking_alpha_v": 0.9}, (0.7, 0.9)),
        ]:
            masked = bsdf("glints_direct", path, alpha=0.2, **parameters)
            ratio = value(masked, si, unit(wo)) / value(plain, si, unit(wo))
            assert ratio == pytest.approx(g1(wi, *alphas) * g1(wo, *alphas), rel=0.02)


# ---- warnings and threads -------------------------------------------------------------------------------------------


def footprint_warnings(lines):
    return [line for line in lines if "without a footprint" in line]


@pytest.mark.parametrize("plugin", FILTERED)
@pytest.mark.parametrize("integrator", ["path", "volpath"])
def test_stock_path_tracers_warn_once(rough_map, plugin, integrator):
    with captured_log() as lines:
        scene = plane_scene(bsdf(plugin, rough_map), integrator)
        mi.render(scene)
        mi.render(scene)
    warnings = footprint_warnings(lines)
    assert len(warnings) == 1
    for fragment in (plugin, "glints_path", "direct", "differentials"):
        assert fragment in warnings[0]


@pytest.mark.parametrize(
    "plugin, integrator", [("glints_ibm", "glints_path"), ("glints_direct", "direct"), ("glints_unfiltered", "path")]
)
def test_no_warning_where_nothing_is_wrong(rough_map, plugin, integrator):
    """Also not at deeper vertices of `glints_path`: a second glinting plane hangs above the first."""
    ceiling = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate((0.5, 0, 0.5)).rotate((0, 1, 0), 180)}
    with captured_log() as lines:
        material = bsdf(plugin, rough_map, alpha=0.2)
        mi.render(plane_scene(material, integrator, ceiling={**ceiling, "bsdf": bsdf(plugin, rough_map, alpha=0.2)}))
    assert not footprint_warnings(lines)


def test_mesh_without_uv_is_reported(rough_map, tmp_path):
    quad = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\n"
    with_uv = quad + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    for content, count in [(with_uv, 0), (quad + "f 1 2 3\nf 1 3 4\n", 1)]:
        (tmp_path / "quad.obj").write_text(content)
        mesh = {"type": "obj", "filename": str(tmp_path / "quad.obj"), "bsdf": bsdf("glints_ibm", rough_map)}
        with captured_log() as lines:
            mi.render(plane_scene({"type": "diffuse"}, "glints_path", mesh=mesh))
        warnings = [line for line in lines if "no uv coordinates" in line]
        assert len(warnings) == len(lines) == count
        assert all("glints_ibm" in line and "texture coordinates" in line for line in warnings)


@pytest.mark.parametrize("plugin", BSDFS)
def test_images_do_not_depend_on_the_number_of_threads(rough_map, plugin):
    """Bit for bit. The blocks are of fixed size: Mitsuba seeds its samplers by block."""
    scene = plane_scene(bsdf(plugin, rough_map, alpha=0.1), {"type": "glints_path", "block_size": 4})
    before = dr.thread_count()
    images = []
    try:
        for threads in (1, 2, 5):
            dr.set_thread_count(threads)
            images.append(np.array(mi.render(scene, seed=7)))
    finally:
        dr.set_thread_count(before)
    assert images[0].max() > 0
    assert np.array_equal(images[0], images[1]) and np.array_equal(images[0], images[2])


def test_timer(rough_map):
    """The measuring library of the benchmarks, with the structures documented in timer.h; it takes any BSDF."""

    time_bsdf = timer.library_call()
    settings = timer.Settings(0.1, 0.1, 0.8, 0.5, 100, 2, 1)

    for material in (bsdf("glints_ibm", rough_map), mi.load_dict({"type": "roughconductor"})):
        timings = timer.Timings()
        assert time_bsdf(material.ptr, settings, timings) is None
        assert min(timings.eval_ns, timings.pdf_ns, timings.sample_ns, timings.eval_pdf_ns) > timings.overhead_ns > 0
        assert 0.5 < timings.valid_samples <= 1 and timings.checksum > 0

    emitter = mi.load_dict({"type": "constant"})
    assert b"not a BSDF" in time_bsdf(emitter.ptr, settings, timer.Timings())
