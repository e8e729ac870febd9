/*
Glints by position-normal distributions (`glints_yan16`)
========================================================

A normal map as a mixture of Gaussians in position and normal, filtered with a Gaussian footprint: Yan, Hasan, Marschner
and Ramamoorthi, "Position-Normal Distributions for Efficient Rendering of Specular Microstructure" (2016), the baseline
of most later papers. Written from the mathematics.

Parameters of this plugin
-------------------------

The common ones are documented in `glints_ibm.cpp`. `normalization` can only be `projected`, `distribution` only
`beckmann`: the elements are Gaussian.

| Parameter         | Type    | Meaning                                                                                |
|-------------------|---------|----------------------------------------------------------------------------------------|
| `elements`        | string  | `flat`: one Gaussian with a constant normal a texel. `curved`: Gaussians that follow   |
|                   |         | the bilinearly interpolated map. (Default: `flat`)                                     |
| `intrinsic`       | float   | Intrinsic roughness sigma_r: standard deviation of a Gaussian's normals, in the        |
|                   |         | projected disk. Instead of `alpha`, which is sqrt(2) times as large.                   |
|                   |         | (Default: what `alpha` = 0.01 stands for, 0.00707)                                     |
| `refinement`      | integer | Curved elements per texel and side: with more of them the mixture comes nearer to the  |
|                   |         | interpolated map, at the square of memory and build time. 0: what the map needs, 1 if  |
|                   |         | it is smooth from texel to texel, else 2. (Default: 0)                                 |
| `footprint_sigma` | float   | Standard deviation of the Gaussian footprint in pixels. 0.5 is that of the published   |
|                   |         | implementation; 0.29 has the variance of the pixel's box, is sharper and faster.       |
|                   |         | (Default: 0.5)                                                                         |

Guidance
--------

- The range of a query is not clamped: at high tiling the whole pixel is filtered, and the cost grows with its texels.
- Curved elements have many more neighbours in position and normal than flat ones, and cost accordingly.
- Footprints, integrators, uv coordinates, sidedness, polarization and variants: as for `glints_ibm`.

XML:

    <bsdf type="glints_yan16">
        <string name="filename" value="flakes.exr"/>
        <float name="intrinsic" value="0.005"/>
        <string name="elements" value="curved"/>
        <string name="material" value="Al"/>
    </bsdf>

Python:

    import mitsuba as mi, mitsuba_glints
    bsdf = mi.load_dict({
        'type': 'glints_yan16',
        'filename': 'flakes.exr',
        'intrinsic': 0.005,
        'elements': 'curved',
        'material': 'Al',
    })
*/
#include "registry.h"

#include <cmath>

static glints::Brdf make_brdf(const mitsuba::Properties &props, const glints::NormalMap &map,
                              const glints::SurfaceOptions &surface) {
    glints::Yan16Options options;
    options.curved = glints_mitsuba::choice_parameter(props, "elements", {"flat", "curved"}) == 1;
    options.footprint_sigma = props.get<float>("footprint_sigma", options.footprint_sigma);
    if (options.curved)
        options.refinement = glints_mitsuba::unsigned_parameter(props, "refinement", 0);

    glints::SurfaceOptions rough = surface;
    rough.alpha = glints_mitsuba::roughness_parameter(props, "intrinsic", std::sqrt(2.f), surface.alpha);
    return glints::Brdf::yan16(map, rough, options);
}

extern "C" MI_EXPORT void init_plugin(std::string_view name, mitsuba::PluginRegisterFn fn) {
    glints_mitsuba::register_bsdf(name, fn, {make_brdf, glints_mitsuba::Footprints::Used});
}
