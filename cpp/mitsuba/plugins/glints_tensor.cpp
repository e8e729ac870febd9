/*
Glints by tensor-decomposed distributions of normals (`glints_tensor`)
======================================================================

All distributions of normals that pixels may see are precomputed, for footprints of all places and sizes, and compressed:
Deng, Liu, Wang and Yang, "Constant-Cost Spatio-Angular Prefiltering of Glinty Appearance Using Tensor Decomposition"
(2022), for geometric optics. A query costs the same whatever the footprint.

Parameters of this plugin
-------------------------

The common ones are documented in `glints_ibm.cpp`. `normalization` can only be `projected`.

| Parameter    | Type    | Meaning                                                                                     |
|--------------|---------|---------------------------------------------------------------------------------------------|
| `filename`   | string  | Normal map. What it needs is precomputed when the scene is loaded, which takes minutes for  |
|              |         | a large map, and saved to `cache`, where it is found the next time.                         |
| `ndf_file`   | string  | Instead of `filename`, `alpha` and `distribution`: a file of `glints precompute tensor`.    |
| `cache`      | string  | Folder of precomputations, named by the map's content and all parameters. It is made if it  |
|              |         | does not exist. (Default: `mitsuba-glints` in `$XDG_CACHE_HOME`, or else in `~/.cache`)     |
| `rank`       | integer | Largest rank of a group of blocks, 1 to 64: memory and time against accuracy. 0: 32, or 16  |
|              |         | with `published`. (Default: 0)                                                              |
| `rank_error` | float   | Relative error of a group of blocks at which a smaller rank is taken. 0: all groups have    |
|              |         | `rank`. (Default: 0)                                                                        |
| `resolution` | integer | Pixels per side of an image of the hemisphere, a multiple of 16. 0: 256, which resolves     |
|              |         | flakes of `alpha` >= 0.0055. (Default: 0)                                                   |
| `stride`     | integer | Texels between the images of the finest level. 0: 32. (Default: 0)                          |
| `published`  | boolean | Solver as published: random start, up to 500 iterations. (Default: false)                   |

Guidance
--------

- The footprint is a Gaussian of half a pixel's standard deviation, as for `glints_yan16`. Footprints narrower than that
  of the finest level (19 texels for a stride of 32) are filtered by the structure of `glints_ibm`, which is built, too.
- Sampling follows the distribution exactly, evaluation and density agree with it.
- Footprints, integrators, uv coordinates, sidedness, polarization and variants: as for `glints_ibm`.

XML:

    <bsdf type="glints_tensor">
        <string name="filename" value="flakes.exr"/>
        <float name="alpha" value="0.01"/>
        <integer name="rank" value="32"/>
        <string name="material" value="Al"/>
    </bsdf>

Python:

    import mitsuba as mi, mitsuba_glints
    bsdf = mi.load_dict({
        'type': 'glints_tensor',
        'ndf_file': 'flakes.glints',
        'material': 'Al',
    })
*/
#include "registry.h"

#include <cstdlib>
#include <filesystem>
#include <mitsuba/core/logger.h>

using namespace mitsuba;

static std::string default_cache(const Properties &props) {
    const char *cache = std::getenv("XDG_CACHE_HOME"), *home = std::getenv("HOME");
    if (cache && *cache)
        return std::string(cache) + "/mitsuba-glints";
    if (home && *home)
        return std::string(home) + "/.cache/mitsuba-glints";
    Throw("%s: parameter \"cache\" is missing, and neither XDG_CACHE_HOME nor HOME is set: name a folder.",
          props.plugin_name());
}

static glints::Brdf make_brdf(const Properties &props, const glints::NormalMap &map,
                              const glints::SurfaceOptions &surface) {
    glints::TensorOptions options;
    options.rank = glints_mitsuba::unsigned_parameter(props, "rank", 0);
    options.error = props.get<float>("rank_error", 0.f);
    options.resolution = glints_mitsuba::unsigned_parameter(props, "resolution", 0);
    options.stride = glints_mitsuba::unsigned_parameter(props, "stride", 0);
    options.published = props.get<bool>("published", false);
    std::string cache =
        props.has_property("cache") ? std::string(props.get<std::string_view>("cache")) : default_cache(props);
    std::string file = glints::Brdf::tensor_cache_file(map, surface, options, cache);
    std::error_code error; // what cannot be looked at is made, or refused with a reason
    if (std::filesystem::exists(file, error))
        Log(Info, "%s: using the precomputation \"%s\".", props.plugin_name(), file);
    else
        Log(Warn,
            "%s: precomputing the distributions of a map of %u x %u texels, once, into \"%s\"; this may take some "
            "minutes. `glints precompute tensor` does it with a progress bar.",
            props.plugin_name(), map.width(), map.height(), file);
    return glints::Brdf::tensor(map, surface, options, cache);
}

static glints::Brdf load_brdf(const Properties &props, const glints::NormalMap *,
                              const glints::SurfaceOptions &surface) {
    const char *name = "ndf_file";
    glints_mitsuba::refuse_together(
        props, name,
        {"filename", "encoding", "flip_y", "alpha", "distribution", "rank", "rank_error", "resolution", "stride",
         "published", "cache"},
        "the file has been made for one map, one kind of flakes and one precomputation; leave one of them out");
    return glints::Brdf::tensor_from_file(glints_mitsuba::file_parameter(props, name), surface);
}

extern "C" MI_EXPORT void init_plugin(std::string_view name, PluginRegisterFn fn) {
    glints_mitsuba::register_bsdf(name, fn, {make_brdf, glints_mitsuba::Footprints::Used, "ndf_file", load_brdf});
}
