// What a plugin file needs: hand its method to the one BSDF class that all glint plugins share.
//
// A plugin file knows Mitsuba's `Properties` and one constructor of the C++ API. It is not a template, includes no
// BSDF header and compiles in a few seconds.
#pragma once

#include <glints/glints.h>
#include <initializer_list>
#include <mitsuba/core/properties.h>
#include <string>
#include <string_view>

// GCC and Clang: visible both when building libglints_mitsuba.so and when using it.
#define GLINTS_MITSUBA_API __attribute__((visibility("default")))

namespace glints_mitsuba {

/// Builds the BRDF of one method. Reads the plugin's own parameters; the common ones are in `surface` already.
using BrdfFactory = glints::Brdf (*)(const mitsuba::Properties &props, const glints::NormalMap &map,
                                     const glints::SurfaceOptions &surface);

/// Loads the BRDF of one method from the file that the parameter `Method::saved` names. `map`: null where the scene names no
/// normal map.
using BrdfLoader = glints::Brdf (*)(const mitsuba::Properties &props, const glints::NormalMap *map,
                                    const glints::SurfaceOptions &surface);

/// Does a method look at more than the centre of the footprint?
enum class Footprints { Used, Ignored };

struct Method {
    BrdfFactory make_brdf;
    Footprints footprints;
    /// Parameter that names a saved structure, in the place of the map or beside it; null: the method's are not saved.
    const char *saved = nullptr;
    BrdfLoader load_brdf = nullptr;
};

/// Offers a BSDF plugin to Mitsuba in all supported variants. Called by the plugin's `init_plugin`.
GLINTS_MITSUBA_API void register_bsdf(std::string_view name, mitsuba::PluginRegisterFn fn, const Method &method);

/// The method registered under a plugin's name.
Method find_method(std::string_view name);

/// Makes every variant that is not supported answer with an error that says which ones are.
GLINTS_MITSUBA_API void refuse_other_variants(std::string_view name, mitsuba::PluginRegisterFn fn,
                                              mitsuba::ObjectType type);

/// A whole, non-negative parameter; `fallback` if it is absent.
GLINTS_MITSUBA_API uint32_t unsigned_parameter(const mitsuba::Properties &props, const char *name, uint32_t fallback);

/// The index of a parameter's text among the choices, of which the first is the default; anything else is refused with
/// the list of what is allowed.
GLINTS_MITSUBA_API size_t choice_parameter(const mitsuba::Properties &props, const char *name,
                                           std::initializer_list<const char *> choices);

/// The parameters `interpolation` and `refinement` of the plugins whose map is resampled to be interpolated.
GLINTS_MITSUBA_API glints::InterpolationOptions interpolation_parameters(const mitsuba::Properties &props);

/// The parameters `footprint_filter` and `footprint_sigma` of the plugins that know more than one filter.
GLINTS_MITSUBA_API glints::FilterOptions filter_parameters(const mitsuba::Properties &props);

/// The file that a parameter names, as the file resolver finds it.
GLINTS_MITSUBA_API std::string file_parameter(const mitsuba::Properties &props, const char *name);

/// Refuses the parameter `a`, which is given, beside the first of the others that is given, too.
GLINTS_MITSUBA_API void refuse_together(const mitsuba::Properties &props, const char *a,
                                        std::initializer_list<const char *> others, const char *advice);

/// Roughness alpha from another parameter that stands for it, alpha = factor * value; `fallback` where it is not given.
/// Both together are refused.
GLINTS_MITSUBA_API float roughness_parameter(const mitsuba::Properties &props, const char *other, float factor,
                                             float fallback);

} // namespace glints_mitsuba
