#include "abi.h"

#include "footprint_scope.h"
#include "glint_bsdf.h"
#include "registry.h"

#include <map>
#include <mitsuba/core/logger.h>
#include <mutex>
#include <sstream>

namespace glints_mitsuba {

using namespace mitsuba;

namespace {

const char *const SupportedVariants[] = {"scalar_rgb", "scalar_spectral", "scalar_spectral_polarized"};

bool is_supported(const std::string &variant) {
    for (const char *supported : SupportedVariants)
        if (variant == supported)
            return true;
    return false;
}

std::mutex methods_mutex;

std::map<std::string, Method, std::less<>> &methods() {
    static std::map<std::string, Method, std::less<>> instance;
    return instance;
}

ref<Object> refuse_variant(void *, const Properties &props) {
    Throw("%s: this variant of Mitsuba is not supported. Choose one of scalar_rgb, scalar_spectral and "
          "scalar_spectral_polarized, e.g. with mi.set_variant(\"scalar_rgb\").",
          props.plugin_name());
}

thread_local bool without_footprint = false;

} // namespace

void refuse_other_variants(std::string_view name, PluginRegisterFn fn, ObjectType type) {
    std::istringstream variants(MI_VARIANTS); // one name a line
    for (std::string variant; std::getline(variants, variant);)
        if (!is_supported(variant))
            fn(name, variant, type, refuse_variant);
}

void register_bsdf(std::string_view name, PluginRegisterFn fn, const Method &method) {
    {
        // Mitsuba loads plugins from several threads.
        std::lock_guard<std::mutex> guard(methods_mutex);
        methods().insert_or_assign(std::string(name), method);
    }
    fn(name, SupportedVariants[0], ObjectType::BSDF, make_glint_bsdf_rgb);
    fn(name, SupportedVariants[1], ObjectType::BSDF, make_glint_bsdf_spectral);
    fn(name, SupportedVariants[2], ObjectType::BSDF, make_glint_bsdf_spectral_polarized);
    refuse_other_variants(name, fn, ObjectType::BSDF);
}

Method find_method(std::string_view name) {
    std::lock_guard<std::mutex> guard(methods_mutex);
    auto found = methods().find(name);
    if (found == methods().end())
        Throw("\"%s\" is not a registered glint BSDF.", name);
    return found->second;
}

NoFootprintScope::NoFootprintScope(bool without) : m_outer(without_footprint) { without_footprint = without; }
NoFootprintScope::~NoFootprintScope() { without_footprint = m_outer; }
bool NoFootprintScope::active() { return without_footprint; }

} // namespace glints_mitsuba
