#include "abi.h"

#include "parameters.h"
#include "registry.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <initializer_list>
#include <mitsuba/core/fresolver.h>
#include <mitsuba/core/logger.h>
#include <mitsuba/render/ior.h>
#include <vector>

namespace glints_mitsuba {

using namespace mitsuba;

namespace {

/// The first of the named parameters that a scene sets, or null.
const char *first_given(const Properties &props, std::initializer_list<const char *> names) {
    for (const char *name : names)
        if (props.has_property(name))
            return name;
    return nullptr;
}

void require_both(const Properties &props, const char *a, const char *b) {
    if (props.has_property(a) != props.has_property(b))
        Throw("%s: parameters \"%s\" and \"%s\" belong together; \"%s\" is missing.", props.plugin_name(), a, b,
              props.has_property(a) ? b : a);
}

[[noreturn]] void refuse_conflict(const Properties &props, const char *a, const char *b, const char *advice) {
    Throw("%s: parameters \"%s\" and \"%s\" exclude each other: %s.", props.plugin_name(), a, b, advice);
}

/// The materials of Mitsuba's library, for an error message.
std::string known_materials() {
    const std::string suffix = ".eta.spd";
    std::string copper = file_resolver()->resolve("data/ior/Cu.eta.spd").string();
    std::vector<std::string> names;
    std::error_code error; // a missing folder gives an empty list
    for (const auto &entry : std::filesystem::directory_iterator(std::filesystem::path(copper).parent_path(), error)) {
        std::string file = entry.path().filename().string();
        if (file.size() > suffix.size() && file.compare(file.size() - suffix.size(), suffix.size(), suffix) == 0)
            names.push_back(file.substr(0, file.size() - suffix.size()));
    }
    std::sort(names.begin(), names.end());
    std::string list;
    for (const std::string &name : names)
        list += (list.empty() ? "" : ", ") + name;
    return list;
}

bool material_exists(const std::string &name) {
    std::error_code error;
    return std::filesystem::exists(file_resolver()->resolve("data/ior/" + name + ".eta.spd").string(), error);
}

/// An index of refraction: a number, or the name of a substance that Mitsuba knows.
float index_of_refraction(const Properties &props, const char *name, const char *fallback) {
    float value;
    if (!props.has_property(name) || props.type(name) == Properties::Type::String) {
        try {
            value = lookup_ior(std::string(props.get<std::string_view>(name, fallback)));
        } catch (const std::exception &e) {
            Throw("%s: parameter \"%s\": %s", props.plugin_name(), name, e.what());
        }
    } else {
        value = props.get<float>(name);
    }
    if (!std::isfinite(value) || value <= 0.f)
        Throw("%s: parameter \"%s\" is %s; an index of refraction must be positive and finite.", props.plugin_name(),
              name, value);
    return value;
}

} // namespace

uint32_t unsigned_parameter(const Properties &props, const char *name, uint32_t fallback) {
    int64_t value = props.get<int64_t>(name, fallback);
    if (value < 0 || value > std::numeric_limits<int32_t>::max())
        Throw("%s: parameter \"%s\" is %d; it must be a positive 32-bit number, or 0 to derive it.",
              props.plugin_name(), name, value);
    return (uint32_t) value;
}

size_t choice_parameter(const Properties &props, const char *name, std::initializer_list<const char *> choices) {
    std::string given(props.get<std::string_view>(name, *choices.begin()));
    std::string allowed;
    size_t index = 0;
    for (const char *choice : choices) {
        if (given == choice)
            return index;
        allowed += (index == 0 ? "\"" : ", \"") + std::string(choice) + "\"";
        ++index;
    }
    Throw("%s: parameter \"%s\" is \"%s\"; it must be one of %s.", props.plugin_name(), name, given, allowed);
}

glints::InterpolationOptions interpolation_parameters(const Properties &props) {
    glints::InterpolationOptions options;
    options.interpolation = glints::Interpolation(choice_parameter(props, "interpolation", {"nearest", "bilinear"}));
    options.refinement = unsigned_parameter(props, "refinement", 0);
    return options;
}

glints::FilterOptions filter_parameters(const Properties &props) {
    glints::FilterOptions options;
    options.filter = glints::FootprintFilter(choice_parameter(props, "footprint_filter", {"box", "gaussian"}));
    if (props.has_property("footprint_sigma") && options.filter != glints::FootprintFilter::Gaussian)
        Throw("%s: parameter \"footprint_sigma\" is the standard deviation of a Gaussian footprint; add "
              "footprint_filter=\"gaussian\", or leave it out.",
              props.plugin_name());
    options.footprint_sigma = props.get<float>("footprint_sigma", options.footprint_sigma);
    return options;
}

std::string file_parameter(const Properties &props, const char *name) {
    return file_resolver()->resolve(props.get<std::string_view>(name)).string();
}

void refuse_together(const Properties &props, const char *a, std::initializer_list<const char *> others,
                     const char *advice) {
    if (const char *other = first_given(props, others))
        refuse_conflict(props, a, other, advice);
}

float roughness_parameter(const Properties &props, const char *other, float factor, float fallback) {
    if (!props.has_property(other))
        return fallback;
    if (props.has_property("alpha"))
        refuse_conflict(props, "alpha", other, "both set the roughness of a flake");
    float value = props.get<float>(other);
    if (!(factor * value >= 1e-4f && factor * value <= 1.f))
        Throw("%s: parameter \"%s\" is %s; it must be in [%s, %s].", props.plugin_name(), other, value, 1e-4f / factor,
              1.f / factor);
    return factor * value;
}

glints::NormalMap load_map(const Parameters &parameters) {
    if (parameters.filename.empty())
        Throw("%s: parameter \"filename\" is missing: give the path of a normal map (EXR, PNG, JPEG or TIFF).",
              parameters.plugin);
    try {
        return glints::NormalMap::load(parameters.filename, parameters.encoding, parameters.flip_y);
    } catch (const glints::Error &e) {
        Throw("%s: %s", parameters.plugin, e.what()); // names the parameter and the file
    }
}

std::string described(const Properties &props) {
    std::string plugin(props.plugin_name());
    return props.id().empty() ? plugin : plugin + " \"" + std::string(props.id()) + "\"";
}

Parameters::Parameters(const Properties &props) : plugin(props.plugin_name()) {
    read_map(props);
    read_placement(props);
    read_surface(props);
    read_masking(props);
    read_interface(props);
}

void Parameters::read_map(const Properties &props) {
    if (props.has_property("filename"))
        filename = file_parameter(props, "filename");
    encoding = glints::Encoding(choice_parameter(props, "encoding", {"auto", "unsigned", "signed"}));
    flip_y = props.get<bool>("flip_y", false);
}

void Parameters::read_placement(const Properties &props) {
    tiles = props.get<float>("tiles", 1.f);
    if (!std::isfinite(tiles) || tiles <= 0.f)
        Throw("%s: parameter \"tiles\" is %s; it must be positive and finite (how often the map repeats over one unit "
              "of uv).",
              plugin, tiles);

    using Transform = AffineTransform<Point<float, 3>>;
    to_uv = props.get<Transform>("to_uv", Transform());
    for (size_t row = 0; row < 2; ++row)
        for (size_t column = 0; column < 3; ++column)
            if (!std::isfinite(to_uv.matrix.entry(row, column)))
                Throw("%s: parameter \"to_uv\" has an entry that is not finite; give a 3x3 transform of uv.", plugin);
}

void Parameters::read_surface(const Properties &props) {
    surface.alpha = props.get<float>("alpha", surface.alpha);
    surface.distribution = glints::Distribution(choice_parameter(props, "distribution", {"beckmann", "ggx"}));
    surface.normalization = glints::Normalization(choice_parameter(props, "normalization", {"projected", "paper"}));
}

void Parameters::read_masking(const Properties &props) {
    bool masked = choice_parameter(props, "masking", {"beckmann", "none"}) == 0;
    surface.masking = masked ? glints::Masking::Beckmann : glints::Masking::None;

    require_both(props, "masking_alpha_u", "masking_alpha_v");
    const char *given = first_given(props, {"masking_alpha_u"});
    if (!given)
        return;
    if (surface.masking == glints::Masking::None)
        refuse_conflict(props, "masking", given, "remove masking=\"none\" or the roughness of the masking");
    surface.masking = glints::Masking::Explicit;
    surface.masking_alpha_u = props.get<float>("masking_alpha_u");
    surface.masking_alpha_v = props.get<float>("masking_alpha_v");
}

void Parameters::read_interface(const Properties &props) {
    const char *library = first_given(props, {"material"});
    const char *conductor = first_given(props, {"eta", "k"});
    const char *dielectric = first_given(props, {"int_ior", "ext_ior"});
    const char *advice = "a surface is a library material, or a conductor with eta and k, or a dielectric";
    if (library && conductor)
        refuse_conflict(props, library, conductor, advice);
    if (library && dielectric)
        refuse_conflict(props, library, dielectric, advice);
    if (conductor && dielectric)
        refuse_conflict(props, conductor, dielectric, advice);

    if (library)
        read_material(props);
    else if (dielectric)
        read_dielectric(props);
    else if (conductor) {
        require_both(props, "eta", "k");
        interface = Interface::EtaK;
    }
}

void Parameters::read_material(const Properties &props) {
    material = std::string(props.get<std::string_view>("material"));
    if (material == "none")
        return;
    if (!material_exists(material))
        Throw("%s: parameter \"material\" is \"%s\", which Mitsuba's library does not have. It has: none, %s.", plugin,
              material, known_materials());
    interface = Interface::Material;
}

void Parameters::read_dielectric(const Properties &props) {
    float inside = index_of_refraction(props, "int_ior", "bk7");
    float outside = index_of_refraction(props, "ext_ior", "air");
    if (inside == outside)
        Throw("%s: parameters \"int_ior\" and \"ext_ior\" are both %s: such a surface reflects nothing. Make them "
              "differ.",
              plugin, inside);
    interface = Interface::Dielectric;
    ior = inside / outside;
}

} // namespace glints_mitsuba
