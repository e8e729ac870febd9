"""Footprints behind the first bounce of `glints_path`."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import NEEDS_DIFFERENTIALS, bsdf, plane_scene, random_normals, unit

RESOLUTION = 8
recorded = []


class BounceRecorder(mi.BSDF):
    """A black material that notes where it is hit, and the partials of uv it is asked with."""

    def __init__(self, props):
        mi.BSDF.__init__(self, props)
        self.m_flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | NEEDS_DIFFERENTIALS
        self.m_components = [self.m_flags]

    def sample(self, ctx, si, sample1, sample2, active):
        recorded.append((*si.uv, *si.duv_dx, *si.duv_dy))
        return mi.BSDFSample3f(), mi.Color3f(0)

    def eval(self, ctx, si, wo, active):
        return mi.Color3f(0)

    def pdf(self, ctx, si, wo, active):
        return 0.0

    def eval_pdf(self, ctx, si, wo, active):
        return mi.Color3f(0), 0.0

    def to_string(self):
        return "BounceRecorder[]"


mi.register_bsdf("bounce_recorder", BounceRecorder)

T = mi.ScalarTransform4f


def camera(to_world, fov=30):
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": to_world,
        "film": {"type": "hdrfilm", "width": RESOLUTION, "height": RESOLUTION, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": 1},
    }


def recordings(camera, integrator, seed=0, spp=1, **objects):
    """One row a hit, sorted by uv: uv, then (du/dx, dv/dx, du/dy, dv/dy)."""
    recorded.clear()
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": camera,
            "integrator": {"type": "glints_path", "footprint": "pixel", "max_depth": 6, **integrator},
            "target": {"type": "rectangle", "to_world": T().scale(20), "bsdf": {"type": "bounce_recorder"}},
            **objects,
        }
    )
    mi.render(scene, seed=seed, spp=spp)
    rows = np.array(recorded)
    return rows[np.lexsort(rows[:, 1::-1].T)]


def gram(rows):
    """The footprints' second moments, which do not depend on the order and sign of the parallelogram's edges."""
    a, b = rows[:, 2:4], rows[:, 4:6]
    return np.einsum("ni,nj->nij", a, a) + np.einsum("ni,nj->nij", b, b)


# ---- mirrors and glass ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["mirror", "twosided mirror", "two mirrors"])
def test_plane_mirrors_show_the_footprint_of_the_mirrored_camera(kind):
    """The same random numbers, so the same rays, mirrored: equal to single precision, perspective included."""
    eye, target = np.array([1.0, -2.0, 2.0]), np.array([0.5, 0.3, 4.0])
    upwards = camera(T().look_at(eye.tolist(), target.tolist(), (0, 0, 1)))
    conductor = {"type": "conductor"}
    if kind == "twosided mirror":
        conductor = {"type": "twosided", "nested": conductor}
    objects = {
        "mirror": {
            "type": "rectangle",
            "to_world": T().translate((0, 0, 4)).rotate((1, 0, 0), 180).scale(20),
            "bsdf": conductor,
        }
    }
    flips = T().translate((0, 0, 8)).scale((1, 1, -1))
    if kind == "two mirrors":
        # The wall x = 6, met between ceiling and floor or before the ceiling.
        wall = T().translate((6, 0, 0)).rotate((0, 1, 0), -90).scale(20)
        objects["wall"] = {"type": "rectangle", "to_world": wall, "bsdf": {"type": "conductor"}}
        upwards = camera(T().look_at(eye.tolist(), (3.5, 0.3, 3.6), (0, 0, 1)), fov=10)
        flips = T().translate((12, 0, 0)).scale((-1, 1, 1)) @ flips
    mirrored = camera(flips @ upwards["to_world"], upwards["fov"])
    found = recordings(upwards, {}, **objects)
    expected = recordings(mirrored, {})
    assert len(found) == RESOLUTION**2 == len(expected)
    assert found[:, :2] == pytest.approx(expected[:, :2], abs=1e-4)
    scale = np.abs(expected[:, 2:]).max()
    assert scale > 1e-3
    assert found[:, 2:] == pytest.approx(expected[:, 2:], abs=2e-3 * scale)
    # Twins: footprints of another size, and none.
    doubled = recordings(upwards, {"footprint": 2.0}, **objects)
    assert np.abs(doubled[:, 2:] - expected[:, 2:]).max() > 0.5 * scale
    assert not recordings(upwards, {"indirect_footprint": 0.0}, **objects)[:, 2:].any()


def bounced(direction, origin, kind):
    """Where a ray meets the plane z = 0 after the mirroring sphere, or after the glass ball, in its uv; exact."""
    o, d = origin.astype(float), unit(direction)

    def sphere(o, d, far):
        b, c = o @ d, o @ o - 1.0
        t = -b + (1 if far else -1) * math.sqrt(b * b - c)
        return o + t * d

    centre = np.array([0.0, 0.0, 3.0])
    p = sphere(o - centre, d, False)
    if kind == "mirror":
        d = d - 2 * (d @ p) * p
    else:

        def refract(d, n, eta):
            cos = -d @ n
            return eta * d + (eta * cos - math.sqrt(1 - eta**2 * (1 - cos * cos))) * n

        d = refract(d, p, 1 / 1.5)
        p = sphere(p, d, True)
        d = refract(d, -p, 1.5)
    p = p + centre
    hit = p - d * (p[2] / d[2])
    return hit[:2] / 40 + 0.5


@pytest.mark.parametrize("kind", ["mirror", "glass"])
def test_curved_surfaces_agree_with_neighbouring_rays(kind):
    """Against central differences of exactly traced rays, a tenth of a pixel apart.

    A pixel is 1/900 of a radian here; the transport is first order, so the error is some pixels squared.
    """
    eye = np.array([0.0, -3.5, 2.3]) if kind == "mirror" else np.array([0.25, 0.1, 4.6])
    aim = (0.0, -0.5, 2.6) if kind == "mirror" else (0.3, 0.35, 3.0)
    fov = 0.5
    to_world = T().look_at(eye.tolist(), aim, (0, 1, 0.1))
    material = {"type": "conductor"} if kind == "mirror" else {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    ball = {"type": "sphere", "center": [0, 0, 3], "radius": 1, "bsdf": material}
    rows = recordings(camera(to_world, fov), {}, spp=64 if kind == "glass" else 1, ball=ball)
    pixel = 2 * math.tan(math.radians(fov / 2)) / RESOLUTION
    axes = np.array(to_world.matrix)[:3, :3]
    half = math.tan(math.radians(fov / 2))
    checked = 0
    # Find each record's ray: the nearest of a dense grid of exactly traced ones.
    grid = np.linspace(-half, half, 401)
    traced = np.array([[bounced(axes @ [x, y, 1.0], eye, kind) for x in grid] for y in grid[::8]])
    for row in rows[:: max(1, len(rows) // 24)]:
        distance = np.linalg.norm(traced - row[:2], axis=-1)
        iy, ix = np.unravel_index(distance.argmin(), distance.shape)
        if distance[iy, ix] > 5e-4:
            continue  # another path: reflected by the glass, or inside it
        x, y = grid[ix], grid[::8][iy]
        # Newton's steps to the ray that was traced.
        for _ in range(4):
            here = bounced(axes @ [x, y, 1.0], eye, kind)
            step = 1e-5
            jacobian = np.stack(
                [
                    (bounced(axes @ [x + step, y, 1.0], eye, kind) - bounced(axes @ [x - step, y, 1.0], eye, kind)),
                    (bounced(axes @ [x, y + step, 1.0], eye, kind) - bounced(axes @ [x, y - step, 1.0], eye, kind)),
                ],
                axis=1,
            ) / (2 * step)
            x, y = np.array([x, y]) + np.linalg.solve(jacobian, row[:2] - here)
        expected = (jacobian @ jacobian.T) * pixel**2
        found = gram(row[None])[0]
        assert found == pytest.approx(expected, abs=0.04 * np.trace(expected))
        assert np.trace(expected) > 0
        checked += 1
    assert checked >= 8


# ---- rough bounces --------------------------------------------------------------------------------------------------


def test_a_rough_bounce_spreads_by_the_solid_angle_of_a_sample():
    """Camera far below a rough ceiling: the footprint on the floor has, across the ray, the side distance / sqrt(pdf)."""
    above = camera(T().look_at((0.0, 0.0, 1.0), (0.0, 0.0, 4.0), (0, 1, 0)), fov=1e-3)
    for name, material in [
        ("rough", {"type": "roughconductor", "alpha": 0.05, "distribution": "beckmann"}),
        ("smooth", {"type": "roughconductor", "alpha": 0.01, "distribution": "beckmann"}),
    ]:
        ceiling = {
            "type": "rectangle",
            "to_world": T().translate((0, 0, 4)).rotate((1, 0, 0), 180).scale(20),
            "bsdf": material,
        }
        rows = recordings(above, {}, spp=16, ceiling=ceiling)
        reference = mi.load_dict(material)
        si = mi.SurfaceInteraction3f()
        si.wi = mi.Vector3f(0, 0, 1)
        ratios, densities = [], []
        for row in rows:
            p = (row[:2] - 0.5) * 40
            wo = unit([p[0], p[1], 4.0])
            pdf = reference.pdf(mi.BSDFContext(), si, mi.Vector3f(*wo))
            distance = 4.0 / wo[2]
            densities.append(pdf)
            # Across the ray and along it: the square is stretched by 1 / cos on the floor.
            area = math.sqrt(np.linalg.det(gram(row[None])[0])) * 40**2
            ratios.append(area * wo[2] / (distance**2 * min(1 / pdf, 1)))
        assert np.array(ratios) == pytest.approx(1.0, abs=0.02), name
        # Twin, where both are below 45 degrees.
        doubled = recordings(above, {"indirect_footprint": 2.0}, spp=16, ceiling=ceiling)
        narrow = np.array(densities) > 4.1
        areas = [np.sqrt(np.linalg.det(gram(r[narrow]))) for r in (rows, doubled)]
        assert narrow.sum() > 500
        assert areas[1] == pytest.approx(4 * areas[0], rel=0.02)


def test_wide_lobes_are_capped():
    """A diffuse ceiling: 45 degrees, at the distance of the floor."""
    above = camera(T().look_at((0.0, 0.0, 1.0), (0.0, 0.0, 4.0), (0, 1, 0)), fov=1e-3)
    ceiling = {
        "type": "rectangle",
        "to_world": T().translate((0, 0, 4)).rotate((1, 0, 0), 180).scale(20),
        "bsdf": {"type": "diffuse"},
    }
    rows = recordings(above, {}, spp=4, ceiling=ceiling)
    p = (rows[:, :2] - 0.5) * 40
    squared = p[:, 0] ** 2 + p[:, 1] ** 2 + 16
    area = np.sqrt(np.linalg.det(gram(rows))) * 40**2
    assert area * 4 / np.sqrt(squared) == pytest.approx(squared, rel=0.02)


# ---- images ---------------------------------------------------------------------------------------------------------


def mirrored_glints(material, integrator, samples):
    """A glinting plane seen in a rough mirror above the camera; the light is a lamp."""
    lamp = {
        "type": "rectangle",
        "to_world": T().translate((1.2, 0.6, 2.5)).rotate((1, 0, 0), 180).scale(0.5),
        "emitter": {"type": "area", "radiance": 10.0},
    }
    mirror = {
        "type": "rectangle",
        "to_world": T().translate((0, 0, 3)).rotate((1, 0, 0), 180).scale(4),
        "bsdf": {"type": "roughconductor", "alpha": 0.03},
    }
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "glints_path", "max_depth": 3, **integrator},
            "plane": {"type": "rectangle", "to_world": T().scale(2), "bsdf": material},
            "lamp": lamp,
            "mirror": mirror,
            "camera": {
                "type": "perspective",
                "fov": 20,
                "to_world": T().look_at((0, -3.5, 1.5), (0, -1.7, 3), (0, 0, 1)),
                "film": {
                    "type": "hdrfilm",
                    "width": 16,
                    "height": 16,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance",
                },
                "sampler": {"type": "independent", "sample_count": samples},
            },
        }
    )


def images(scene, seeds):
    return np.array([np.array(mi.render(scene, seed=seed))[..., 0] for seed in seeds])


def test_glints_in_a_rough_mirror_have_less_noise_and_the_same_mean(make_map):
    """At equal sample counts, against an unfiltered reference; the mean within 4 standard errors and 3 % of bias.

    The twin: without deeper footprints the noise is what it was.
    """
    filename = make_map(random_normals(256, 256, 0.15, seed=4))
    glints = bsdf("glints_ibm", filename, alpha=0.03, tiles=4)
    unfiltered = bsdf("glints_unfiltered", filename, alpha=0.03, tiles=4)
    reference = images(mirrored_glints(unfiltered, {}, 512), range(500, 508))

    def statistics(integrator):
        rendered = images(mirrored_glints(glints, integrator, 4), range(24))
        return (
            rendered.mean(),
            rendered.mean(axis=(1, 2)).std(ddof=1) / math.sqrt(24),
            rendered.var(axis=0, ddof=1).mean(),
        )

    expected = reference.mean()
    expected_error = reference.mean(axis=(1, 2)).std(ddof=1) / math.sqrt(len(reference))
    mean, error, variance = statistics({"footprint": "pixel"})
    _, _, off = statistics({"footprint": "pixel", "indirect_footprint": 0.0})
    print(
        f"mean {mean:.4f} +- {error:.4f}, reference {expected:.4f} +- {expected_error:.4f}, variance {variance / off:.3f}"
    )
    assert expected > 0
    assert abs(mean - expected) < 4 * math.hypot(error, expected_error) + 0.03 * expected
    assert variance < 0.5 * off


def test_threads_do_not_matter(make_map):
    glints = bsdf("glints_ibm", make_map(random_normals(64, 64, 0.15)), alpha=0.05)
    scene = mirrored_glints(glints, {}, 2)

    before = dr.thread_count()
    try:
        dr.set_thread_count(1)
        one = np.array(mi.render(scene, seed=3))
        dr.set_thread_count(3)
        three = np.array(mi.render(scene, seed=3))
    finally:
        dr.set_thread_count(before)
    assert one.max() > 0
    assert np.array_equal(one, three)


def test_parameters_outside_their_domain_are_refused():
    for name, value in [("indirect_footprint", -1.0), ("environment_lobes", 0), ("environment_epsilon", 1.5)]:
        with pytest.raises(RuntimeError, match=name):
            mi.load_dict({"type": "glints_path", name: value})
    assert "indirect_footprint = 0.5" in str(mi.load_dict({"type": "glints_path", "indirect_footprint": 0.5}))


def test_other_integrals_do_not_change(make_map):
    """A camera's vertex alone, depth 2: deeper footprints are none of its business, bit for bit."""
    material = bsdf("glints_ibm", make_map(random_normals(64, 64, 0.2)), alpha=0.05)

    def render(scale):
        integrator = {"type": "glints_path", "max_depth": 2, "indirect_footprint": scale}
        return np.array(mi.render(plane_scene(material, integrator), seed=1))

    assert np.array_equal(render(0.0), render(1.0))
