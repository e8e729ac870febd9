// The BSDF class behind all glint plugins: everything that Mitsuba asks of a material, around a `glints::Brdf`.

#include "abi.h"

#include "glint_bsdf.h"
#include "input_warnings.h"
#include "parameters.h"
#include "prefiltered_bsdf.h"
#include "reflectance.h"
#include "registry.h"
#include "uv_footprint.h"

#include <mitsuba/core/util.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/texture.h>
#include <optional>

namespace glints_mitsuba {

using namespace mitsuba;

namespace {

/// Loads the structure where the method can and the scene names one, else builds it from the map.
glints::Brdf make_brdf(const Method &method, const Properties &props, const Parameters &parameters) {
    bool is_saved = method.saved && props.has_property(method.saved);
    std::optional<glints::NormalMap> map;
    if (!is_saved || !parameters.filename.empty())
        map = load_map(parameters);
    try {
        if (is_saved)
            return method.load_brdf(props, map ? &*map : nullptr, parameters.surface);
        // That a large map takes its time is said first. (From here: a thread of its own would wait for Python's lock.)
        Log(Info, "%s: \"%s\", building the structure of %u x %u texels …", parameters.plugin, parameters.filename,
            map->width(), map->height());
        return method.make_brdf(props, *map, parameters.surface);
    } catch (const glints::Error &e) {
        if (!map)
            Throw("%s: %s", parameters.plugin, e.what());
        Throw("%s: %s (normal map \"%s\")", parameters.plugin, e.what(), parameters.filename);
    }
}

/// What the surface comes from, for messages: the saved structure, if there is one, or the map.
std::string source(const Method &method, const Properties &props, const Parameters &parameters) {
    if (method.saved && props.has_property(method.saved))
        return file_parameter(props, method.saved);
    return parameters.filename;
}

const char *distribution_name(glints::Distribution distribution) {
    return distribution == glints::Distribution::Ggx ? "ggx" : "beckmann";
}

glints::Vec3 vec3(const Vector<float, 3> &v) { return {v.x(), v.y(), v.z()}; }

} // namespace

/**
 * A normal map filtered over the pixel's footprint, with Fresnel term and colour.
 *
 * One-sided, one glossy component. The filtered NDF comes from `glints::Brdf`, whose answers are scalar; this class
 * adds the colour, which only depends on the half vector. In polarized variants the reflection depolarises: the flakes
 * of a footprint have different planes of incidence, and their mixture is approximated as unpolarised.
 */
template <typename Float, typename Spectrum>
class GlintBSDF final : public BSDF<Float, Spectrum>, public PrefilteredBSDF<Float, Spectrum> {
public:
    MI_IMPORT_BASE(BSDF, m_flags, m_components)
    MI_IMPORT_TYPES(Texture)

    explicit GlintBSDF(const Properties &props) : GlintBSDF(props, Parameters(props)) {}

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext &ctx, const SurfaceInteraction3f &si, Float sample1,
                                             const Point2f &sample2, Mask active) const override {
        MI_MASKED_FUNCTION(ProfilerPhase::BSDFSample, active);
        BSDFSample3f bs = dr::zeros<BSDFSample3f>();
        if (!reflects(ctx, si.wi, active))
            return {bs, 0.f};

        glints::Sample s = m_brdf.sample(footprint(si), vec3(si.wi), sample1, sample2.x(), sample2.y());
        if (!s.valid || !(s.pdf > 0.f))
            return {bs, 0.f};
        bs.wo = Vector3f(s.wo.x, s.wo.y, s.wo.z);
        bs.pdf = s.pdf;
        bs.eta = 1.f;
        bs.sampled_type = +BSDFFlags::GlossyReflection;
        bs.sampled_component = 0;
        return {bs, coloured(si, bs.wo, s.value / s.pdf)};
    }

    Spectrum eval(const BSDFContext &ctx, const SurfaceInteraction3f &si, const Vector3f &wo,
                  Mask active) const override {
        MI_MASKED_FUNCTION(ProfilerPhase::BSDFEvaluate, active);
        if (!reflects(ctx, si.wi, active) || !above_horizon(wo))
            return 0.f;
        return coloured(si, wo, m_brdf.value(footprint(si), vec3(si.wi), vec3(wo)));
    }

    Float pdf(const BSDFContext &ctx, const SurfaceInteraction3f &si, const Vector3f &wo, Mask active) const override {
        MI_MASKED_FUNCTION(ProfilerPhase::BSDFEvaluate, active);
        if (!reflects(ctx, si.wi, active) || !above_horizon(wo))
            return 0.f;
        return m_brdf.pdf(footprint(si), vec3(si.wi), vec3(wo));
    }

    std::pair<Spectrum, Float> eval_pdf(const BSDFContext &ctx, const SurfaceInteraction3f &si, const Vector3f &wo,
                                        Mask active) const override {
        MI_MASKED_FUNCTION(ProfilerPhase::BSDFEvaluate, active);
        if (!reflects(ctx, si.wi, active) || !above_horizon(wo))
            return {0.f, 0.f};
        glints::Evaluation e = m_brdf.evaluate(footprint(si), vec3(si.wi), vec3(wo));
        return {coloured(si, wo, e.value), e.pdf};
    }

    bool prefilters() const override { return m_brdf.prefilters(); }

    typename PrefilteredBSDF<Float, Spectrum>::Draw sample_environment(const SurfaceInteraction3f &si,
                                                                       const Vector3f &z,
                                                                       const glints::Environment &environment,
                                                                       Float u1, const Point2f &u2) const override {
        glints::LobeSample s =
            m_brdf.sample_environment(footprint(si), vec3(si.wi), vec3(si.sh_frame.s), vec3(si.sh_frame.t), vec3(z),
                                      environment, u1, u2.x(), u2.y());
        if (!s.valid)
            return {};
        Vector3f wo(s.wo.x, s.wo.y, s.wo.z);
        return {s.lobe, wo, coloured(si, wo, s.value / s.probability), true};
    }

    void traverse(TraversalCallback *callback) override { m_reflectance.traverse(callback); }

    std::string to_string() const override {
        glints::Statistics s = m_brdf.statistics();
        std::ostringstream out;
        out << "GlintBSDF[\n"
            << "  plugin = " << m_parameters.plugin << ",\n"
            << "  filename = \"" << m_source << "\",\n"
            << "  resolution = " << s.width << " x " << s.height << ",\n"
            << "  distribution = " << distribution_name(s.distribution) << ",\n"
            << "  alpha = " << s.alpha << ",\n"
            << "  tiles = " << m_parameters.tiles << ",\n"
            << "  to_uv = " << string::indent(m_parameters.to_uv.matrix, 10) << ",\n"
            << m_reflectance.to_string() << ",\n"
            << "  masking_alpha = [" << s.masking_alpha_u << ", " << s.masking_alpha_v << "],\n"
            << "  bins = " << s.bins << ",\n"
            << "  refinement = " << s.refinement << ",\n"
            << "  refinement_step = " << s.refinement_step << ",\n"
            << "  structure_bytes = " << s.structure_bytes << ",\n"
            << "  build_seconds = " << s.build_seconds << "\n"
            << "]";
        return out.str();
    }

    MI_DECLARE_CLASS(GlintBSDF)

private:
    GlintBSDF(const Properties &props, const Parameters &parameters)
        : Base(props), m_parameters(parameters), m_method(find_method(parameters.plugin)),
          m_source(source(m_method, props, parameters)), m_brdf(make_brdf(m_method, props, parameters)),
          m_uv_footprint(parameters), m_reflectance(props, parameters),
          m_warnings(described(props), m_method.footprints == Footprints::Used) {
        m_flags =
            BSDFFlags::GlossyReflection | BSDFFlags::FrontSide | BSDFFlags::SpatiallyVarying | BSDFFlags::Anisotropic;
        if (m_method.footprints == Footprints::Used)
            m_flags = m_flags | BSDFFlags::NeedsDifferentials;
        // Adapters such as `twosided` rebuild their flags from the components.
        m_components.push_back(m_flags);
        log_statistics();
    }

    void log_statistics() const {
        glints::Statistics s = m_brdf.statistics();
        const char *made = m_source == m_parameters.filename ? "built" : "loaded";
        Log(Info, "%s: \"%s\", %u x %u texels, %s, %s in %s.", m_parameters.plugin, m_source, s.width, s.height,
            util::mem_string(s.structure_bytes), made, util::time_string((float) (1e3 * s.build_seconds), true));
        if (!s.warning.empty())
            Log(Warn, "%s: \"%s\": %s.", m_parameters.plugin, m_source, s.warning);
    }

    static bool above_horizon(const Vector3f &w) { return Frame3f::cos_theta(w) > 0.f; }

    static bool reflects(const BSDFContext &ctx, const Vector3f &wi, Mask active) {
        return active && ctx.is_enabled(BSDFFlags::GlossyReflection) && above_horizon(wi);
    }

    /// `value` times Fresnel term and colour at the half vector of wi and wo.
    Spectrum coloured(const SurfaceInteraction3f &si, const Vector3f &wo, Float value) const {
        if (!(value > 0.f))
            return 0.f;
        Vector3f half = dr::normalize(si.wi + wo);
        return depolarizer<Spectrum>(m_reflectance.eval(si, dr::dot(si.wi, half)) * value);
    }

    glints::Footprint footprint(const SurfaceInteraction3f &si) const {
        m_warnings.check(si);
        return m_uv_footprint(si.uv, si.duv_dx, si.duv_dy);
    }

    Parameters m_parameters;
    Method m_method;
    std::string m_source;
    glints::Brdf m_brdf;
    UvFootprint m_uv_footprint;
    Reflectance<Float, Spectrum> m_reflectance;
    InputWarnings<Float, Spectrum> m_warnings;
};

ref<Object> make_glint_bsdf_rgb(void *, const Properties &props) {
    return new GlintBSDF<float, Color<float, 3>>(props);
}

ref<Object> make_glint_bsdf_spectral(void *, const Properties &props) {
    return new GlintBSDF<float, Spectrum<float, 4>>(props);
}

ref<Object> make_glint_bsdf_spectral_polarized(void *, const Properties &props) {
    return new GlintBSDF<float, MuellerMatrix<Spectrum<float, 4>>>(props);
}

} // namespace glints_mitsuba
