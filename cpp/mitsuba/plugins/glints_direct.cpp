/*
Glints by direct summation (`glints_direct`)
============================================

The exact reflection of a normal map's flakes over each pixel's footprint: the sum over every texel that the footprint
covers (Eq. 11 of Atanasov et al. 2021), without bins and without any data structure. The ground truth of `glints_ibm`.

Parameters of this plugin
-------------------------

The common ones are documented in `glints_ibm.cpp`, and so are `interpolation` and `refinement`.

| Parameter          | Type   | Meaning                                                                                |
|--------------------|--------|----------------------------------------------------------------------------------------|
| `footprint_filter` | string | How the pixel weights what it covers. `box`: evenly over the parallelogram of the ray  |
|                    |        | differentials. `gaussian`: by a Gaussian with the parallelogram's edges as axes, cut   |
|                    |        | at 3.74 standard deviations, the footprint of `glints_yan16`. (Default: `box`)         |
| `footprint_sigma`  | float  | Standard deviation of the Gaussian in pixels, in [0.05, 4]: 0.5 is that of Yan et al.'s|
|                    |        | published implementation, 0.288675 has the variance of the box. (Default: 0.5)         |

Guidance
--------

- The time of an evaluation grows with the number of covered texels: seconds per megapixel for a few texels, hours for
  strongly minified maps. Meant for tests and references of small images.
- `footprint_filter` = `gaussian` shows what smooth reconstruction makes of a surface, and is the ground truth of methods
  with such a footprint, `glints_yan16` with flat elements (which blur by another 0.42 texels) and direct sums of the
  literature. With 0.5 pixels it reaches 14 times as many texels as the box.
- Footprints, integrators, uv coordinates, sidedness, polarization and variants: as for `glints_ibm`.

XML:

    <bsdf type="glints_direct">
        <string name="filename" value="flakes.exr"/>
        <float name="alpha" value="0.007"/>
        <string name="material" value="Al"/>
    </bsdf>

Python:

    import mitsuba as mi, mitsuba_glints
    bsdf = mi.load_dict({'type': 'glints_direct', 'filename': 'flakes.exr', 'alpha': 0.007, 'material': 'Al'})
*/
#include "registry.h"

static glints::Brdf make_brdf(const mitsuba::Properties &props, const glints::NormalMap &map,
                              const glints::SurfaceOptions &surface) {
    return glints::Brdf::direct(map, surface, glints_mitsuba::interpolation_parameters(props),
                                glints_mitsuba::filter_parameters(props));
}

extern "C" MI_EXPORT void init_plugin(std::string_view name, mitsuba::PluginRegisterFn fn) {
    glints_mitsuba::register_bsdf(name, fn, {make_brdf, glints_mitsuba::Footprints::Used});
}
