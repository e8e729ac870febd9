/*
Glints without filtering (`glints_unfiltered`)
==============================================

The reflection of the one flake under the shading point (Eq. 5 of Atanasov et al. 2021), whatever the pixel's footprint:
what `glints_ibm` and `glints_direct` filter. With very many samples per pixel its images are the independent reference
of theirs; with few they are noisy and flicker.

Parameters of this plugin
-------------------------

The common ones are documented in `glints_ibm.cpp`.

| Parameter       | Type   | Meaning                                                                               |
|-----------------|--------|---------------------------------------------------------------------------------------|
| `interpolation` | string | What the surface is between the centres of texels. `nearest`: piecewise flat, one     |
|                 |        | flake a texel, as the other plugins see it. `bilinear`: the projected normals are     |
|                 |        | interpolated, the surface of `glints_yan16` with curved elements. (Default: `nearest`)|

Guidance
--------

- It needs no ray differentials: every integrator will do, and it never warns about a missing footprint.
- The same reflectance model as the filtered plugins, term by term. Mitsuba's `normalmap` over `roughconductor` is close
  to it for small slopes only: it has other cosine and masking terms.
- uv coordinates, sidedness, polarization and variants: as for `glints_ibm`.

XML:

    <bsdf type="glints_unfiltered">
        <string name="filename" value="flakes.exr"/>
        <float name="alpha" value="0.007"/>
        <string name="material" value="Al"/>
    </bsdf>

Python:

    import mitsuba as mi, mitsuba_glints
    bsdf = mi.load_dict({'type': 'glints_unfiltered', 'filename': 'flakes.exr', 'alpha': 0.007, 'material': 'Al'})
*/
#include "registry.h"

static glints::Brdf make_brdf(const mitsuba::Properties &props, const glints::NormalMap &map,
                              const glints::SurfaceOptions &surface) {
    auto interpolation = glints_mitsuba::choice_parameter(props, "interpolation", {"nearest", "bilinear"});
    return glints::Brdf::unfiltered(map, surface, glints::Interpolation(interpolation));
}

extern "C" MI_EXPORT void init_plugin(std::string_view name, mitsuba::PluginRegisterFn fn) {
    glints_mitsuba::register_bsdf(name, fn, {make_brdf, glints_mitsuba::Footprints::Ignored});
}
