/*
Glints by direct summation (`glints_direct`)
============================================

The exact reflection of a normal map's flakes over each pixel's footprint: the sum over every texel that the footprint
covers (Eq. 11 of Atanasov et al. 2021), without bins and without any data structure. The ground truth of `glints_ibm`.

The parameters are the common ones, documented in `glints_ibm.cpp`, and `interpolation` and `refinement` of `glints_ibm`.

Guidance
--------

- The time of an evaluation grows with the number of covered texels: seconds per megapixel for a few texels, hours for
  strongly minified maps. Meant for tests and references of small images.
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
    return glints::Brdf::direct(map, surface, glints_mitsuba::interpolation_parameters(props));
}

extern "C" MI_EXPORT void init_plugin(std::string_view name, mitsuba::PluginRegisterFn fn) {
    glints_mitsuba::register_bsdf(name, fn, {make_brdf, glints_mitsuba::Footprints::Used});
}
