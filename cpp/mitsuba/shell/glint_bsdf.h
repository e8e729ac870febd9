// The BSDF class behind all glint plugins, one constructor per supported variant.
#pragma once

#include <mitsuba/core/properties.h>

namespace glints_mitsuba {

// Their type is `mitsuba::PluginInstantiateFn`. The method is looked up by the plugin's name in `props`.
mitsuba::ref<mitsuba::Object> make_glint_bsdf_rgb(void *, const mitsuba::Properties &props);
mitsuba::ref<mitsuba::Object> make_glint_bsdf_spectral(void *, const mitsuba::Properties &props);
mitsuba::ref<mitsuba::Object> make_glint_bsdf_spectral_polarized(void *, const mitsuba::Properties &props);

} // namespace glints_mitsuba
