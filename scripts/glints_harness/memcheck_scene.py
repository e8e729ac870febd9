"""Renders 8 x 8 pixels with every glint plugin, on one thread: what `memcheck` looks at."""

import sys

import drjit as dr
import mitsuba as mi

mi.set_variant("scalar_rgb")
dr.set_thread_count(1)

import mitsuba_glints  # noqa: F401  (makes the plugins loadable)

STEEP = {"alpha": 0.1}
MATERIALS = {
    "glints_ibm": {"type": "glints_ibm", "material": "Al", **STEEP},
    "glints_ibm, sharp flakes": {"type": "glints_ibm", "alpha": 0.004},
    "glints_ibm, structure = paper": {"type": "glints_ibm", "structure": "paper", **STEEP},
    "glints_ibm, mirrors": {"type": "glints_ibm", "alpha": 0.0, "bins": 31},
    "glints_ibm, interpolated": {"type": "glints_ibm", "interpolation": "bilinear", "refinement": 2, **STEEP},
    "glints_yan16": {"type": "glints_yan16", **STEEP},
    "glints_yan16, curved": {"type": "glints_yan16", "elements": "curved", **STEEP},
    "glints_direct": {"type": "glints_direct", "distribution": "ggx", **STEEP},
    "glints_unfiltered": {"type": "glints_unfiltered", **STEEP},
    "glints_carpaint": {"type": "glints_carpaint", "coat_roughness": 0.2, **STEEP},
}


def render(material):
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "glints_path", "max_depth": 3},
            "plane": {"type": "rectangle", "bsdf": material},
            "light": {"type": "constant"},
            "camera": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at(origin=(0, -2, 2), target=(0, 0, 0), up=(0, 0, 1)),
                "film": {"type": "hdrfilm", "width": 8, "height": 8},
                "sampler": {"type": "independent", "sample_count": 2},
            },
        }
    )
    image = mi.TensorXf(mi.render(scene))
    assert dr.all(dr.isfinite(image.array)) and dr.sum(image.array) > 0, material


def main(normal_map, mask, structure):
    for name, material in MATERIALS.items():
        gaps = {"mask": mask} if material["type"] == "glints_carpaint" else {}
        render({**material, "filename": normal_map, **gaps})
        print(name, flush=True)
    render({"type": "glints_ibm", "structure_file": structure})
    print("glints_ibm, structure_file", flush=True)


main(*sys.argv[1:])
