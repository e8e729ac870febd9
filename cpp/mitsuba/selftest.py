"""Proves that the freshly built plugins and the installed Mitsuba agree on every structure they exchange.

A plugin compiled with other flags than Mitsuba's wheel loads without complaint and reads garbage. So the build ends with
closed forms, evaluated through the loaded plugins in all three variants: positions of fields (directions, uv, its
partials, wavelengths), colours, Mueller matrices, and whole renderings with footprints.

Needs nothing but Mitsuba: it runs in pip's isolated build environment.

    python selftest.py FOLDER_OF_THE_PACKAGE
"""

import itertools
import math
import os
import struct
import sys
import tempfile
import zlib

import drjit as dr
import mitsuba as mi

ALPHA = 0.04
BSDFS = ("glints_unfiltered", "glints_direct", "glints_ibm")
FLAT, TILTED = (0, 0, 255), (51, 0, 255)
INCIDENT = [(0.0, 0.0, 1.0), (0.3, 0.2, 1.0), (-0.2, 0.4, 1.0)]
OFFSETS = [(0.0, 0.0), (0.02, -0.01)]  # of the half vector from a flake's normal


# ---- maps and closed forms ------------------------------------------------------------------------------------------


def write_png(path, rows):
    """An 8-bit RGB image; with `encoding` `signed` the byte 255 is exactly 1."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", len(rows[0]), len(rows), 8, 2, 0, 0, 0)
    pixels = b"".join(b"\0" + bytes(c for texel in row for c in texel) for row in rows)
    with open(path, "wb") as file:
        file.write(
            b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")
        )


def unit(v):
    length = math.sqrt(sum(x * x for x in v))
    return [x / length for x in v]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def smith_g1(cos):
    """Beckmann, in the rational approximation of Walter et al. 2007."""
    a = cos / (ALPHA * math.sqrt(max(1e-12, 1 - cos * cos)))
    return 1.0 if a >= 1.6 else (3.535 * a + 2.181 * a * a) / (1 + 2.276 * a + 2.577 * a * a)


def reflection(wi, wo, t):
    """Value and density of one flake with normal t: D(h,t) G1 G1 / (4 (t.n) (i.n)), D(h,t) (h.t) / (4 (o.h))."""
    wi, wo, t = unit(wi), unit(wo), unit(t)
    h = unit([a + b for a, b in zip(wi, wo)])
    cos2 = dot(h, t) ** 2
    d = math.exp(-(1 - cos2) / (cos2 * ALPHA**2)) / (math.pi * ALPHA**2 * cos2**2)
    value = d * smith_g1(dot(wi, t)) * smith_g1(dot(wo, t)) / (4 * t[2] * wi[2])
    return value, d * dot(h, t) / (4 * dot(wo, h))


def reflected(wi, h):
    wi, h = unit(wi), unit(h)
    return [2 * dot(wi, h) * b - a for a, b in zip(wi, h)]


def mean(pairs):
    return [sum(values) / len(pairs) for values in zip(*pairs)]


# ---- checks ---------------------------------------------------------------------------------------------------------


def expect(what, actual, expected, tolerance):
    if not abs(actual - expected) <= tolerance * abs(expected):
        raise SystemExit(
            f"\nself-test FAILED: {what}: {actual}, but the closed form is {expected}.\n"
            "The plugins and Mitsuba disagree about their binary interface (compiler flags, versions of mitsuba, drjit or\n"
            "nanobind), or a method is wrong. Do not use this build."
        )


def channels(spectrum):
    """All components of a colour, a spectrum, or the first entry of a Mueller matrix."""
    if mi.variant().endswith("polarized"):
        spectrum = spectrum[0, 0]
    return [float(spectrum[i]) for i in range(len(spectrum))]


def interaction(uv, wi, width_u=0.0, width_v=0.0):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.uv, si.duv_dx, si.duv_dy, si.wi = uv, (width_u, 0), (0, width_v), mi.ScalarVector3f(*unit(wi))
    if mi.variant() != "scalar_rgb":
        si.wavelengths = (450, 520, 580, 650)
    return si


def tolerance(plugin):
    """The others are exact up to single precision; `glints_ibm` shows a lobe in the resolution of its bins.

    A single lobe is the worst case for it. How accurate it is over real maps has tests of its own; here a field of a
    structure at the wrong place would be off by orders of magnitude.
    """
    return 0.5 if plugin == "glints_ibm" else 1e-3


def check_evaluation(make_bsdf, plugin):
    """Value, density and sample for one texel and for a footprint over two halves of two texels."""
    bsdf = make_bsdf(plugin)
    context = mi.BSDFContext()
    for (uv_inside, normal), wi, (dx, dy) in itertools.product(
        [((0.25, 0.4), FLAT), ((-0.25, 7.4), TILTED)], INCIDENT, OFFSETS
    ):
        x, y, z = unit(normal)
        wo = reflected(wi, (x + dx, y + dy, z))
        cases = [(uv_inside, 0.0, reflection(wi, wo, normal))]
        if plugin != "glints_unfiltered":
            cases.append(((0.5, 0.5), 0.5, mean([reflection(wi, wo, FLAT), reflection(wi, wo, TILTED)])))
        for uv, width, (value, pdf) in cases:
            si = interaction(uv, wi, width, width)
            direction = mi.Vector3f(unit(wo))
            what = f"{mi.variant()}: {plugin} at uv {uv}, footprint {width}, wi {wi}, wo {wo}"
            for channel in channels(bsdf.eval(context, si, direction)):
                expect(what + ", value", channel, value, tolerance(plugin))
            expect(what + ", density", bsdf.pdf(context, si, direction), pdf, tolerance(plugin))
            both = bsdf.eval_pdf(context, si, direction)
            expect(what + ", eval_pdf", channels(both[0])[0], value, tolerance(plugin))
            expect(what + ", eval_pdf", both[1], pdf, tolerance(plugin))
            sample, weight = bsdf.sample(context, si, 0.3, (0.1, 0.7))
            expected = channels(bsdf.eval(context, si, sample.wo))[0] / sample.pdf
            expect(what + ", sample", channels(weight)[0], expected, 1e-4)
            expect(what + ", sample", bsdf.pdf(context, si, sample.wo), sample.pdf, 1e-4)


def check_colour(make_bsdf, plugin):
    """Every channel carries its own factor."""
    colour = {"type": "rgb", "value": [0.2, 0.5, 0.8]}
    coloured, white = make_bsdf(plugin, specular_reflectance=colour), make_bsdf(plugin)
    texture = mi.load_dict(colour)
    context, si, wo = mi.BSDFContext(), interaction((0.2, 0.2), (0.03, 0.02, 1.0)), mi.Vector3f(0, 0, 1)
    factors = [float(f) for f in texture.eval(si)]
    if max(factors) - min(factors) < 0.1:
        raise SystemExit("self-test FAILED: the colour of the test has no contrast")
    results = zip(channels(coloured.eval(context, si, wo)), channels(white.eval(context, si, wo)), factors)
    for i, (with_colour, without, factor) in enumerate(results):
        expect(f"{mi.variant()}: {plugin}, specular_reflectance, channel {i}", with_colour, factor * without, 1e-4)


def check_rendering(make_bsdf, plugin, integrator, tolerance):
    """Differentials arrive: pixels that cover many periods of a two-texel pattern all show its mean.

    Camera and light are parallel, so that the closed form is the same in every pixel. Without differentials each pixel
    would show one of two values that differ by an order of magnitude.
    """
    wi = (0.3, 0.2, 1.0)
    wo = reflected(wi, (0.02, 0.0, 1.0))
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "plane": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(50),
                "bsdf": make_bsdf(plugin, tiles=5000.0),
            },
            "light": {
                "type": "directional",
                "direction": [-x for x in wo],
                "irradiance": {"type": "spectrum", "value": 1.0},
            },
            "camera": {
                "type": "orthographic",
                "to_world": mi.ScalarTransform4f().look_at(origin=[2 * x for x in wi], target=(0, 0, 0), up=(0, 1, 0)),
                "film": {
                    "type": "hdrfilm",
                    "width": 4,
                    "height": 4,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance",
                },
                "sampler": {"type": "independent", "sample_count": 4},
            },
        }
    )
    expected, _ = mean([reflection(wi, wo, FLAT), reflection(wi, wo, TILTED)])
    pixels = [float(value) for value in mi.render(scene).array]
    what = f"{mi.variant()}: {plugin} under {integrator['type']}"
    if mi.variant() == "scalar_rgb":
        for pixel in pixels:
            expect(what + ", one pixel", pixel, expected, tolerance)
    else:  # random wavelengths make single pixels noisy
        expect(what + ", mean", sum(pixels) / len(pixels), expected, 0.5)


def main(package_folder):
    mi.file_resolver().prepend(package_folder)
    mi.set_log_level(mi.LogLevel.Error)  # points without a footprint are tested on purpose
    with tempfile.TemporaryDirectory() as folder:
        map_file = os.path.join(folder, "two_normals.png")
        write_png(map_file, [[FLAT, TILTED]] * 2)

        def make_bsdf(plugin, **parameters):
            common = {"type": plugin, "filename": map_file, "encoding": "signed", "alpha": ALPHA, "masking": "none"}
            return mi.load_dict({**common, **parameters})

        for variant in ("scalar_rgb", "scalar_spectral", "scalar_spectral_polarized"):
            mi.set_variant(variant)
            for plugin in BSDFS:
                check_evaluation(make_bsdf, plugin)
                check_colour(make_bsdf, plugin)
            for integrator in (
                {"type": "glints_path"},
                {"type": "glints_path", "footprint": "pixel"},
                {"type": "direct"},
            ):
                check_rendering(make_bsdf, "glints_direct", integrator, 0.06)
            check_rendering(make_bsdf, "glints_ibm", {"type": "glints_path"}, 0.5)
    print(f"self-test passed: {', '.join(BSDFS)}, glints_path in three variants of Mitsuba {mi.__version__}")


if __name__ == "__main__":
    main(sys.argv[1])
