/*
Glints by an inverse bin map (`glints_ibm`)
===========================================

A surface of specular flakes given by a normal map, whose reflection is filtered over each pixel's footprint:
Atanasov et al., "A Multiscale Microfacet Model Based on Inverse Bin Mapping" (2021). With `alpha` = 0 the flakes are
mirrors: Atanasov et al., "Efficient Multiscale Rendering of Specular Microstructure" (2020).

Parameters that all glint BSDFs share
-------------------------------------

| Parameter              | Type          | Meaning                                                                    |
|------------------------|---------------|----------------------------------------------------------------------------|
| `filename`             | string        | Normal map: EXR, PNG, JPEG or TIFF, of any size, square or not. It is      |
|                        |               | addressed as by Mitsuba's `bitmap` (repeat, nearest), and its normals live |
|                        |               | in the local shading frame, as in `normalmap`. (Required)                  |
| `encoding`             | string        | How a component c of the file becomes one of the normal: `unsigned`,       |
|                        |               | n = 2c - 1; `signed`, n = c; `auto`, `signed` for floating-point files     |
|                        |               | that hold a negative component, else `unsigned`. (Default: `auto`)         |
| `flip_y`               | boolean       | Negates the green component, for maps with y downwards. (Default: false)   |
| `tiles`                | float         | Repetitions of the map over one unit of uv. (Default: 1)                   |
| `to_uv`                | transform     | 3x3 transform of uv, applied before `tiles`. (Default: identity)           |
| `alpha`                | float         | Roughness of one flake (texel), in [0.0001, 1]. (Default: 0.01)            |
| `distribution`         | string        | Microfacets of one flake: `beckmann`, or `ggx` with a heavy tail, which    |
|                        |               | puts a glow around every glint. (Default: `beckmann`)                      |
| `material`             | string        | Conductor from Mitsuba's library, such as `Cu` or `Al`, or `none`.         |
| `eta`, `k`             | spectrum or   | Conductor: real and imaginary part of the index of refraction. Both are    |
|                        | texture       | needed. Instead of `material`. *Exposed*                                   |
| `int_ior`, `ext_ior`   | float, string | Dielectric: index of refraction inside and outside, a number or a name     |
|                        |               | known to Mitsuba. Only the reflection is modelled.                         |
|                        |               | (Default, if the other one is given: `bk7`, `air`)                         |
|                        |               | With none of these there is no Fresnel term: flakes reflect everything.    |
| `specular_reflectance` | spectrum or   | Factor on the reflection. (Default: 1) *Exposed*                           |
|                        | texture       |                                                                            |
| `normalization`        | string        | Weight of the texels of a footprint. `projected`: their share of the       |
|                        |               | projected area, so that the distribution of normals integrates to one      |
|                        |               | against the cosine. `paper`: their share of the texture's area, the        |
|                        |               | literal Eq. 5. (Default: `projected`)                                      |
| `masking`              | string        | Shadowing and masking of the whole map, besides the flakes' own.           |
|                        |               | `beckmann`: Smith term with the roughness of the map's slopes, anisotropic.|
|                        |               | `none`: no such term. (Default: `beckmann`)                                |
| `masking_alpha_u`,     | float         | Roughness of the `beckmann` masking along u and v, instead of the map's    |
| `masking_alpha_v`      |               | own. Both are needed.                                                      |

Parameters of this plugin
-------------------------

| Parameter   | Type    | Meaning                                                                                      |
|-------------|---------|----------------------------------------------------------------------------------------------|
| `structure_ | string  | A structure that `./scripts/glints precompute ibm MAP -o FILE` saved. It is mapped into      |
| file`       |         | memory, and nothing is built; `filename` is not needed. `alpha`, `distribution` and          |
|             |         | `normalization` are those of the file: leave them out, others are refused. (Default: none)   |
| `structure` | string  | `compact`: this project's structure, half as large, with lobes where the map has them.       |
|             |         | `paper`: that of the publication, lobes at the centres of bins. (Default: `compact`; `paper` |
|             |         | where one of the following parameters is given or `alpha` is 0: they are the paper's alone)  |
| `alpha`     | float   | As above, or 0: each flake is a mirror, shown in the resolution of the bins, without shadow- |
|             |         | ing of its own.                                                                              |
| `bins`      | integer | Bins per side of the grid over the hemisphere of normals. 0: as many as the flakes'          |
|             |         | roughness asks for. Required with `alpha` = 0. (Default: 0)                                  |
| `binning`   | string  | How the hemisphere is cut. `projected`: squares on the projected hemisphere.                 |
|             |         | `equal_solid_angle`: cells of one solid angle, only with `alpha` = 0, and there the default. |
|             |         | (Default with roughness: `projected`)                                                        |
| `leaf_size` | integer | Most texels in a leaf of the forest over the map. Larger: less memory, slower evaluation. 0: |
|             |         | the paper's 10, with `alpha` = 0 its 16. (Default: 0)                                        |
| `interpol-  | string  | What the surface is between the centres of texels. `nearest`: piecewise flat, one flake a    |
| ation`      |         | texel. `bilinear`: the projected normals are interpolated, the surface of `glints_yan16`     |
|             |         | with curved elements. (Default: `nearest`)                                                   |
| `refinement`| integer | With `bilinear`: the interpolated map is resampled to so many texels per texel and side, 1   |
|             |         | to 8, at the square of memory and build time. 0: as many as its bends ask for, a power of two|
|             |         | at which normals of neighbours are at most 1.5 standard deviations of a flake's lobe apart   |
|             |         | (`alpha` / sqrt(2), root mean square), as far as 8 and 8192 x 8192 texels in all go; a warn- |
|             |         | ing tells where that is too few. Required with `alpha` = 0. (Default: 0)                     |
| `footprint_ | string  | How the pixel weights what it covers: `box`, evenly, or `gaussian`, as for `glints_direct`.   |
| filter`     |         | Only the compact structure has the Gaussian, built or from `structure_file`: the paper's     |
|             |         | counts texels of equal weight. (Default: `box`)                                              |
| `footprint_ | float   | Standard deviation of the Gaussian in pixels, in [0.05, 4], as for `glints_direct`.          |
| sigma`      |         | (Default: 0.5)                                                                               |

Guidance
--------

- `structure_file` stands for the map, its interpolation and the flakes; images are bit for bit those of a structure that
  is built from the map. If `filename` is given, too, it must be that map, which is told by a checksum of its normals, at
  the cost of reading it. `interpolation` and `refinement`, if given, must be those of the file. The file may be replaced
  while it is in use (`precompute --force` does), but must not be written to. Several BSDFs and processes share one copy
  of it in memory.
- `alpha` is the roughness of a single flake, not of the surface: that comes from the map. 0.0025 gives hard, sparse
  glints, 0.16 a smooth look with hardly any. Half of it asks for four times the bins.
- `distribution` = `ggx`: a lobe is cut off at seven times its roughness, 2 % of it lie outside and are moved inside. In the
  paper's structure the bins around a normal hold 83 % of its lobe; the rest of the tail is moved into them, so that
  energy is kept, but little of the glow is seen. A quarter of the `bins` holds 99 %; `glints_direct` shows all of it.
- `interpolation` = `bilinear` is for maps that mean a smooth surface, such as bumps, waves and scratches. Flakes are flat:
  interpolated, their borders become slopes that are not there. It takes 4 bytes times the square of the refinement for
  each texel, and 12 more while it is built. Distributions of normals come within 3 % of the interpolated surface's where a
  footprint covers some texels, if the refinement is not cut short. Masking stays that of the map as it is given.
- `alpha` = 0: the talk shows car paint with 127 bins a side, scratched metal with 63 (4K maps) and 255 (8K). A bin is
  as large as a disk of radius 1.4 / `bins` radians: every flake reflects into a lobe of that width, and the reflections
  of small lights show the bins' outlines where a footprint covers few flakes.
- The footprint comes from ray differentials. Render with `glints_path` (of this package) or with `direct`: Mitsuba's
  other integrators drop the differentials, and the BSDF then shows single texels and says so once.
- With many samples per pixel Mitsuba shrinks the footprint to that of one sample; see `footprint` of `glints_path`.
- Deeper vertices of a path have the footprint that `glints_path` carries to them; see its `indirect_footprint`.
- The mesh needs uv coordinates, best without strong distortion: the tangent frame of the map follows them.
- One-sided, like `roughconductor`: wrap it in `twosided` if both sides are seen.
- In polarized variants the reflection depolarises.
- Variants: `scalar_rgb`, `scalar_spectral`, `scalar_spectral_polarized`.

XML:

    <bsdf type="glints_ibm">
        <string name="filename" value="flakes.exr"/>
        <float name="alpha" value="0.007"/>
        <float name="tiles" value="8"/>
        <string name="material" value="Al"/>
    </bsdf>

    <bsdf type="glints_ibm">
        <string name="structure_file" value="flakes.glints"/>
        <float name="tiles" value="8"/>
    </bsdf>

Python:

    import mitsuba as mi, mitsuba_glints
    bsdf = mi.load_dict({
        'type': 'glints_ibm',
        'filename': 'flakes.exr',
        'alpha': 0.007,
        'tiles': 8,
        'material': 'Al',
    })
*/
#include "registry.h"

static glints::Brdf make_brdf(const mitsuba::Properties &props, const glints::NormalMap &map,
                              const glints::SurfaceOptions &surface) {
    glints::InverseBinMapOptions options;
    if (props.has_property("structure")) {
        size_t choice = glints_mitsuba::choice_parameter(props, "structure", {"compact", "paper"});
        options.structure = choice == 0 ? glints::Structure::Compact : glints::Structure::Paper;
    }
    options.bins = glints_mitsuba::unsigned_parameter(props, "bins", 0);
    options.leaf_size = glints_mitsuba::unsigned_parameter(props, "leaf_size", 0);
    if (props.has_property("binning")) {
        size_t choice = glints_mitsuba::choice_parameter(props, "binning", {"projected", "equal_solid_angle"});
        options.binning = choice == 0 ? glints::Binning::Projected : glints::Binning::EqualSolidAngle;
    }
    return glints::Brdf::inverse_bin_map(map, surface, options, glints_mitsuba::interpolation_parameters(props),
                                         glints_mitsuba::filter_parameters(props));
}

/// The interpolation that a scene asks for must be that of the file; `found` texels for each, or 0.
static void check_interpolation(const mitsuba::Properties &props, const std::string &file, uint32_t found) {
    glints::InterpolationOptions asked = glints_mitsuba::interpolation_parameters(props);
    bool is_bilinear = asked.interpolation == glints::Interpolation::Bilinear;
    if (props.has_property("interpolation") && is_bilinear != (found > 0))
        throw glints::Error("parameter \"interpolation\" is not what structure_file \"" + file +
                            "\" was made for, \"" + (found > 0 ? "bilinear" : "nearest") +
                            "\"; leave it out, or make another file with " +
                            "`glints precompute ibm --interpolation`");
    if (asked.refinement > 0 && asked.refinement != found)
        throw glints::Error("parameter \"refinement\" = " + std::to_string(asked.refinement) +
                            ": is not what structure_file \"" + file + "\" was made for, " + std::to_string(found) +
                            "; leave it out, or make another file with `glints precompute ibm --refinement`");
}

static glints::Brdf load_brdf(const mitsuba::Properties &props, const glints::NormalMap *map,
                              const glints::SurfaceOptions &common) {
    const char *name = "structure_file";
    glints_mitsuba::refuse_together(props, name, {"bins", "leaf_size", "binning"},
                                    "the file holds the compact structure, which has none; leave one of them out");
    if (props.has_property("structure") && glints_mitsuba::choice_parameter(props, "structure", {"compact", "paper"}))
        glints_mitsuba::refuse_together(props, name, {"structure"},
                                        "the file holds the compact structure; leave one of them out");
    if (!map)
        glints_mitsuba::refuse_together(
            props, name, {"encoding", "flip_y"},
            "nothing is read but the file; leave one of them out, or give \"filename\", too");

    glints::SurfaceOptions surface = common; // what a scene leaves open is as the file was made for
    std::string file = glints_mitsuba::file_parameter(props, name);
    glints::SavedStructure saved = glints::SavedStructure::read(file);
    check_interpolation(props, file, saved.refinement);
    if (!props.has_property("alpha"))
        surface.alpha = saved.alpha;
    if (!props.has_property("distribution"))
        surface.distribution = saved.distribution;
    if (!props.has_property("normalization"))
        surface.normalization = saved.normalization;
    return glints::Brdf::load_inverse_bin_map(file, surface, map, glints_mitsuba::filter_parameters(props));
}

extern "C" MI_EXPORT void init_plugin(std::string_view name, mitsuba::PluginRegisterFn fn) {
    glints_mitsuba::register_bsdf(name, fn,
                                  {make_brdf, glints_mitsuba::Footprints::Used, "structure_file", load_brdf});
}
