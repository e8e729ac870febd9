/*
Metallic car paint (`glints_carpaint`)
======================================

A paint of three layers, as in Section 6 of Atanasov et al., "A Multiscale Microfacet Model Based on Inverse Bin
Mapping" (2021): a specular coat, a layer of metallic flakes given by a normal map and filtered over each pixel's
footprint, and below the gaps of that layer a base with a diffuse and a glossy term.

| Parameter           | Type          | Meaning                                                                       |
|---------------------|---------------|-------------------------------------------------------------------------------|
| `filename`          | string        | Normal map of the flakes. (Required)                                          |
| `mask`              | string        | Image of the same size: a texel holds a flake where it is 1/2 or more (its    |
|                     |               | red channel, if there are several). (Default: every texel holds one)          |
| `alpha`             | float         | Beckmann roughness of one flake, in [0.0001, 1]; with a mask below about 0.12 |
|                     |               | (see Model). 0.0025 gives hard, sparse glints, 0.04 a smooth look.            |
|                     |               | (Default: 0.01)                                                               |
| `flake_reflectance` | spectrum or   | Colour of the flakes. (Default: 0.9) *Exposed*                                |
|                     | texture       |                                                                               |
| `gtr_gamma`,        | float         | The GTR distribution that the flakes' orientations were drawn from; its Smith |
| `gtr_alpha`         |               | term shadows and masks the layer. Both are needed.                            |
|                     |               | (Default: a Smith term as set by `masking`)                                   |
| `coat_int_ior`      | float, string | Index of refraction of the coat, in (1, 3]. (Default: 1.5)                    |
| `coat_roughness`    | float         | 0: a clear coat with mirror reflection. Else Beckmann roughness of the coat,  |
|                     |               | in [0.001, 1]. (Default: 0)                                                   |
| `base_color`        | spectrum or   | Diffuse reflectance of the base. (Default: 0.1) *Exposed*                     |
|                     | texture       |                                                                               |
| `base_specular`     | spectrum or   | Glossy reflectance of the base; the diffuse term gets what it leaves, so that |
|                     | texture       | nothing is gained. (Default: 0) *Exposed*                                     |
| `base_roughness`    | float         | Beckmann roughness of the glossy term, in [0.01, 1]. (Default: 0.3)           |
| `bins`, `leaf_size` | integer       | As for `glints_ibm`.                                                          |

`encoding`, `flip_y`, `tiles`, `to_uv`, `normalization`, `masking`, `masking_alpha_u` and `masking_alpha_v` are those
of `glints_ibm`, too.

Model
-----

With directions refracted into the coat, w -> w', by Snell's law at the mean surface, and the coat's transmittance T,

    f(wi, wo) = f_coat(wi, wo) + T(wi) T(wo) / eta^2 (F(wi', wo') + (1 - a) B(wi', wo')).

- a is the share of the footprint that flakes cover, from the mip map of the mask; F is the sum over the footprint's
  flakes, whose shares sum to a. Texels without flake do not contribute to F: their normals are turned to the horizon,
  whose lobe is exactly zero under the coat, where directions lie within asin(1 / eta) of the normal. Flakes that are
  too rough for that are refused.
- A density of directions carries the factor of refraction, d w' / d w = cos / (eta^2 cos').
- T = 1 - R, with R Fresnel's reflectance of a clear coat, or the albedo of a rough one. The light that a rough coat
  transmits is refracted as by a clear one.
- Light reflected back down by the coat's inner side is put back for the diffuse term, by the mean reflectance of what
  lies below: the term is divided by 1 - R_inner A, A = a flake_reflectance + (1 - a) (diffuse + base_specular). A white
  base without flakes under any coat then reflects everything. What the coat throws back of the flakes' and of the
  glossy reflection (4 % of it near the normal for 1.5, more at tilts near 40 degrees inside, all beyond) is
  absorbed.
- The model is reciprocal, up to the flakes' truncated lobes, and never reflects more than it receives.
- `sample` draws a gap with its exact share of the footprint; value and density of the base use the mip map's. They are
  equal up to 256 texels, and within 0.01 beyond.
- In polarized variants the reflection depolarises, also that of the coat.

Footprints, integrators, uv coordinates, sidedness and variants: as for `glints_ibm`.

XML:

    <bsdf type="glints_carpaint">
        <string name="filename" value="flakes.exr"/>
        <string name="mask" value="flakes_mask.png"/>
        <float name="tiles" value="4"/>
        <float name="alpha" value="0.005"/>
        <float name="gtr_gamma" value="1.5"/>
        <float name="gtr_alpha" value="0.002"/>
        <rgb name="base_color" value="0.3, 0.01, 0.01"/>
    </bsdf>

Python:

    import mitsuba as mi, mitsuba_glints
    bsdf = mi.load_dict({
        'type': 'glints_carpaint',
        'filename': 'flakes.exr',
        'mask': 'flakes_mask.png',
        'tiles': 4,
        'alpha': 0.005,
        'gtr_gamma': 1.5,
        'gtr_alpha': 0.002,
        'base_color': {'type': 'rgb', 'value': [0.3, 0.01, 0.01]},
    })
*/
#include "abi.h"

#include "input_warnings.h"
#include "parameters.h"
#include "registry.h"
#include "uv_footprint.h"

#include <algorithm>
#include <array>
#include <mitsuba/core/fresolver.h>
#include <mitsuba/core/util.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/fresnel.h>
#include <mitsuba/render/ior.h>
#include <mitsuba/render/microfacet.h>
#include <mitsuba/render/texture.h>

namespace glints_mitsuba {

using namespace mitsuba;

/// The coat's reflectance for light from outside, as a function of the cosine of its angle.
class CoatReflectance {
public:
    using Distribution = MicrofacetDistribution<float, Color<float, 3>>;

    CoatReflectance(float eta, float roughness) : m_eta(eta) {
        if (roughness > 0.f)
            tabulate(Distribution(MicrofacetType::Beckmann, roughness));
        // Half of the mean over the hemisphere: the midpoint rule for the integral of T cos.
        const int steps = 4096;
        double transmitted = 0;
        for (int i = 0; i < steps; ++i) {
            float cos = ((float) i + .5f) / (float) steps;
            transmitted += (1.0 - (*this)(cos)) * cos / steps;
        }
        m_inner = (float) (1.0 - 2.0 * transmitted / ((double) eta * eta));
    }

    float operator()(float cos) const {
        if (m_table.empty())
            return std::get<0>(fresnel(cos, m_eta));
        float position = std::clamp(cos, 0.f, 1.f) * (float) (m_table.size() - 1);
        size_t i = std::min((size_t) position, m_table.size() - 2);
        float f = position - (float) i;
        return m_table[i] * (1.f - f) + m_table[i + 1] * f;
    }

    /// Share of diffuse light from below that does not leave: by reciprocity from the transmittance from outside.
    float inner() const { return m_inner; }

private:
    /// The albedo of the rough coat, from stratified samples of its visible normals.
    void tabulate(const Distribution &distribution) {
        const size_t intervals = 128, side = 32;
        for (size_t i = 0; i <= intervals; ++i) {
            float cos = std::max((float) i / intervals, 1e-4f);
            Vector<float, 3> wi(std::sqrt(1.f - cos * cos), 0.f, cos);
            double sum = 0;
            for (size_t j = 0; j < side * side; ++j) {
                Point<float, 2> u(((float) (j % side) + .5f) / side, ((float) (j / side) + .5f) / side);
                Normal<float, 3> m = std::get<0>(distribution.sample(wi, u));
                Vector<float, 3> wo = reflect(wi, m);
                if (wo.z() > 0.f)
                    sum += std::get<0>(fresnel(dr::dot(wi, m), m_eta)) * distribution.smith_g1(wo, m);
            }
            m_table.push_back((float) (sum / (side * side)));
        }
    }

    float m_eta, m_inner = 0.f;
    std::vector<float> m_table; ///< over the cosine; empty for a clear coat
};

/// The paint's own parameters, checked.
struct PaintParameters {
    explicit PaintParameters(const Properties &props) {
        mask = std::string(props.get<std::string_view>("mask", ""));
        if (!mask.empty())
            mask = file_resolver()->resolve(mask).string();
        read_gtr(props);
        bins = unsigned_parameter(props, "bins", 0);
        leaf_size = unsigned_parameter(props, "leaf_size", 0);
        read_coat(props);
        base_roughness = props.get<float>("base_roughness", .3f);
        if (!(base_roughness >= .01f && base_roughness <= 1.f))
            Throw("%s: parameter \"base_roughness\" is %s; it must be a Beckmann roughness in [0.01, 1].",
                  props.plugin_name(), base_roughness);
    }

    std::string mask;
    float gtr_gamma = 0.f, gtr_alpha = 0.f; ///< 0: not given
    uint32_t bins, leaf_size;
    float eta, coat_roughness, base_roughness;

private:
    void read_gtr(const Properties &props) {
        if (props.has_property("gtr_gamma") != props.has_property("gtr_alpha"))
            Throw("%s: parameters \"gtr_gamma\" and \"gtr_alpha\" belong together; give both.", props.plugin_name());
        if (!props.has_property("gtr_gamma"))
            return;
        for (const char *other : {"masking", "masking_alpha_u"})
            if (props.has_property(other))
                Throw("%s: parameters \"gtr_gamma\" and \"%s\" exclude each other: both set the shadowing and masking "
                      "of the layer.",
                      props.plugin_name(), other);
        gtr_gamma = props.get<float>("gtr_gamma");
        gtr_alpha = props.get<float>("gtr_alpha");
        if (!(gtr_gamma > 0.f && gtr_gamma <= 10.f)) // 0 stands for none further down
            Throw("%s: parameter \"gtr_gamma\" is %s; it must be an exponent in (0, 10].", props.plugin_name(),
                  gtr_gamma);
    }

    void read_coat(const Properties &props) {
        try {
            eta = lookup_ior(props, "coat_int_ior", 1.5f);
        } catch (const std::exception &e) {
            Throw("%s: parameter \"coat_int_ior\": %s", props.plugin_name(), e.what());
        }
        if (!(eta > 1.f && eta <= 3.f))
            Throw("%s: parameter \"coat_int_ior\" is %s; it must be an index of refraction in (1, 3].",
                  props.plugin_name(), eta);
        coat_roughness = props.get<float>("coat_roughness", 0.f);
        if (coat_roughness != 0.f && !(coat_roughness >= .001f && coat_roughness <= 1.f))
            Throw(
                "%s: parameter \"coat_roughness\" is %s; it must be 0 (clear) or a Beckmann roughness in [0.001, 1].",
                props.plugin_name(), coat_roughness);
    }
};

static glints::FlakeLayer make_layer(const Parameters &parameters, const PaintParameters &paint,
                                     const glints::NormalMap &map) {
    if (parameters.interface != Interface::None)
        Throw(
            "%s: the flakes of a paint have no index of refraction: remove \"material\", \"eta\", \"k\", \"int_ior\" "
            "and \"ext_ior\", and give their colour as \"flake_reflectance\" (and the coat's \"coat_int_ior\").",
            parameters.plugin);
    glints::FlakeLayerOptions options;
    options.method.bins = paint.bins;
    options.method.leaf_size = paint.leaf_size;
    options.mask = paint.mask;
    options.gtr_gamma = paint.gtr_gamma;
    options.gtr_alpha = paint.gtr_alpha;
    options.largest_sine = 1.f / paint.eta;
    Log(Info, "%s: \"%s\", building the structure of %u x %u texels …", parameters.plugin, parameters.filename,
        map.width(), map.height());
    try {
        return glints::FlakeLayer::inverse_bin_map(map, parameters.surface, options);
    } catch (const glints::Error &e) {
        Throw("%s: %s (normal map \"%s\"%s)", parameters.plugin, e.what(), parameters.filename,
              paint.mask.empty() ? "" : ", mask \"" + paint.mask + "\"");
    }
}

template <typename Float, typename Spectrum>
class CarPaint final : public BSDF<Float, Spectrum> {
public:
    MI_IMPORT_BASE(BSDF, m_flags, m_components)
    MI_IMPORT_TYPES(Texture)
    using Distribution = MicrofacetDistribution<Float, Spectrum>;

    explicit CarPaint(const Properties &props) : CarPaint(props, Parameters(props), PaintParameters(props)) {}

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext &ctx, const SurfaceInteraction3f &si, Float sample1,
                                             const Point2f &sample2, Mask active) const override {
        MI_MASKED_FUNCTION(ProfilerPhase::BSDFSample, active);
        BSDFSample3f bs = dr::zeros<BSDFSample3f>();
        if (!active || !above_horizon(si.wi))
            return {bs, 0.f};
        Query query(*this, ctx, si);
        bs.eta = 1.f;
        if (sample1 < query.coat_probability)
            return sample_coat(query, sample2, bs);

        Float u = (sample1 - query.coat_probability) / (1.f - query.coat_probability);
        auto [component, inside] = sample_substrate(query, u, sample2);
        Vector3f wo = emerged(inside);
        if (component == None || !above_horizon(wo))
            return {bs, 0.f};
        return finish(query, component, wo, bs);
    }

    Spectrum eval(const BSDFContext &ctx, const SurfaceInteraction3f &si, const Vector3f &wo,
                  Mask active) const override {
        return eval_pdf(ctx, si, wo, active).first;
    }

    Float pdf(const BSDFContext &ctx, const SurfaceInteraction3f &si, const Vector3f &wo, Mask active) const override {
        return eval_pdf(ctx, si, wo, active).second;
    }

    std::pair<Spectrum, Float> eval_pdf(const BSDFContext &ctx, const SurfaceInteraction3f &si, const Vector3f &wo,
                                        Mask active) const override {
        MI_MASKED_FUNCTION(ProfilerPhase::BSDFEvaluate, active);
        if (!active || !above_horizon(si.wi) || !above_horizon(wo))
            return {0.f, 0.f};
        auto [value, density] = evaluate(Query(*this, ctx, si), wo);
        return {depolarizer<Spectrum>(value), density};
    }

    void traverse(TraversalCallback *callback) override {
        callback->put("flake_reflectance", m_flake_reflectance, ParamFlags::Differentiable);
        callback->put("base_color", m_base_color, ParamFlags::Differentiable);
        callback->put("base_specular", m_base_specular, ParamFlags::Differentiable);
    }

    std::string to_string() const override {
        glints::Statistics s = m_layer.statistics();
        std::ostringstream out;
        out << "CarPaint[\n"
            << "  plugin = " << m_parameters.plugin << ",\n"
            << "  filename = \"" << m_parameters.filename << "\",\n"
            << "  mask = \"" << m_paint.mask << "\",\n"
            << "  resolution = " << m_width << " x " << m_height << ",\n"
            << "  alpha = " << s.alpha << ",\n"
            << "  tiles = " << m_parameters.tiles << ",\n"
            << "  to_uv = " << string::indent(m_parameters.to_uv.matrix, 10) << ",\n"
            << "  flake_reflectance = " << string::indent(m_flake_reflectance) << ",\n"
            << "  gtr = [" << m_paint.gtr_gamma << ", " << m_paint.gtr_alpha << "],\n"
            << "  masking_alpha = [" << s.masking_alpha_u << ", " << s.masking_alpha_v << "],\n"
            << "  coat_int_ior = " << m_paint.eta << ",\n"
            << "  coat_roughness = " << m_paint.coat_roughness << ",\n"
            << "  base_color = " << string::indent(m_base_color) << ",\n"
            << "  base_specular = " << string::indent(m_base_specular) << ",\n"
            << "  base_roughness = " << m_paint.base_roughness << ",\n"
            << "  bins = " << s.bins << ",\n"
            << "  structure_bytes = " << s.structure_bytes << ",\n"
            << "  build_seconds = " << s.build_seconds << "\n"
            << "]";
        return out.str();
    }

    MI_DECLARE_CLASS(CarPaint)

private:
    enum Component : uint32_t { Coat, Flakes, Diffuse, Glossy, Count, None = Count };

    /// What depends on the shading point and the viewer's direction only.
    struct Query {
        Query(const CarPaint &paint, const BSDFContext &ctx, const SurfaceInteraction3f &si)
            : wi(si.wi), inside(paint.refracted(si.wi)), footprint(paint.footprint(si)),
              cover(paint.m_layer.cover(footprint)), flakes(paint.m_flake_reflectance->eval(si)),
              glossy(paint.m_base_specular->eval(si)), diffuse(paint.m_base_color->eval(si) * (1.f - glossy)) {
            for (uint32_t i = 0; i < Count; ++i)
                enabled[i] = ctx.is_enabled(paint.type_of(Component(i)), i);
            choose(paint.m_coat(wi.z()));
        }

        /// Mean reflectance of what lies below the coat, at most 1 also for colours that are no reflectances.
        UnpolarizedSpectrum albedo() const {
            return dr::minimum(cover * flakes + (1.f - cover) * (diffuse + glossy), 1.f);
        }

        Vector3f wi, inside; ///< towards the viewer, outside and within the coat
        glints::Footprint footprint;
        Float cover;
        UnpolarizedSpectrum flakes, glossy, diffuse;
        std::array<bool, Count> enabled;
        Float coat_reflectance;
        Float coat_probability;    ///< of sampling the coat rather than what lies below
        Float diffuse_probability; ///< of sampling the diffuse rather than the glossy term, once in a gap

    private:
        void choose(Float reflectance) {
            coat_reflectance = reflectance;
            Float below = enabled[Flakes] || enabled[Diffuse] || enabled[Glossy]
                              ? (1.f - reflectance) * dr::mean(albedo())
                              : 0.f;
            Float above = enabled[Coat] ? reflectance : 0.f;
            coat_probability = above > 0.f ? above / (above + below) : 0.f;
            Float d = enabled[Diffuse] ? dr::mean(diffuse) : 0.f, g = enabled[Glossy] ? dr::mean(glossy) : 0.f;
            diffuse_probability = d + g > 0.f ? d / (d + g) : 1.f;
        }
    };

    CarPaint(const Properties &props, const Parameters &parameters, const PaintParameters &paint)
        : CarPaint(props, parameters, paint, load_map(parameters)) {}

    CarPaint(const Properties &props, const Parameters &parameters, const PaintParameters &paint,
             const glints::NormalMap &map)
        : Base(props), m_parameters(parameters), m_paint(paint), m_layer(make_layer(parameters, paint, map)),
          m_uv_footprint(parameters), m_coat(paint.eta, paint.coat_roughness), m_width(map.width()),
          m_height(map.height()), m_warnings(described(props), true) {
        m_flake_reflectance = props.get_texture<Texture>("flake_reflectance", .9f);
        m_base_color = props.get_texture<Texture>("base_color", .1f);
        m_base_specular = props.get_texture<Texture>("base_specular", 0.f);
        // Adapters such as `twosided` rebuild their flags from the components, so each has all that it needs.
        for (uint32_t i = 0; i < Count; ++i) {
            auto flags = type_of(Component(i)) | BSDFFlags::FrontSide | BSDFFlags::NeedsDifferentials;
            if (i != Coat)
                flags = flags | BSDFFlags::SpatiallyVarying;
            if (i == Flakes)
                flags = flags | BSDFFlags::Anisotropic;
            m_components.push_back(flags);
            m_flags = m_flags | flags;
        }
        glints::Statistics s = m_layer.statistics();
        Log(Info, "%s: \"%s\", %u x %u texels, %s, built in %s.", m_parameters.plugin, m_parameters.filename, m_width,
            m_height, util::mem_string(s.structure_bytes), util::time_string((float) (1e3 * s.build_seconds), true));
    }

    BSDFFlags type_of(Component component) const {
        if (component == Coat)
            return clear() ? BSDFFlags::DeltaReflection : BSDFFlags::GlossyReflection;
        return component == Diffuse ? BSDFFlags::DiffuseReflection : BSDFFlags::GlossyReflection;
    }

    bool clear() const { return m_paint.coat_roughness == 0.f; }

    static bool above_horizon(const Vector3f &w) { return Frame3f::cos_theta(w) > 0.f; }

    // ---- refraction at the mean surface ------------------------------------------------------------------------------

    /// A direction outside, as it continues within the coat.
    Vector3f refracted(const Vector3f &w) const {
        Float x = w.x() / m_paint.eta, y = w.y() / m_paint.eta;
        return {x, y, dr::safe_sqrt(1.f - x * x - y * y)};
    }

    /// The inverse; zero for a direction that is reflected totally.
    Vector3f emerged(const Vector3f &w) const {
        Float x = w.x() * m_paint.eta, y = w.y() * m_paint.eta;
        Float z2 = 1.f - x * x - y * y;
        return w.z() > 0.f && z2 > 0.f ? dr::normalize(Vector3f(x, y, dr::sqrt(z2))) : Vector3f(0.f);
    }

    // ---- value and density -------------------------------------------------------------------------------------------

    using Evaluation = std::pair<UnpolarizedSpectrum, Float>;

    /// f cos theta_o and the density of `wo`, without the mirror reflection of a clear coat.
    Evaluation evaluate(const Query &query, const Vector3f &wo) const {
        Vector3f inside = refracted(wo);
        auto [value, density] = evaluate_substrate(query, inside);
        Float refraction = wo.z() / (m_paint.eta * m_paint.eta * inside.z()); // d wo' / d wo
        value *= (1.f - query.coat_reflectance) * (1.f - m_coat(wo.z())) * refraction;
        density *= (1.f - query.coat_probability) * refraction;
        if (!clear() && query.enabled[Coat]) {
            auto [coat, coat_density] = evaluate_rough(coat_distribution(), query.wi, wo);
            Float cos = dr::dot(query.wi, dr::normalize(query.wi + wo));
            value += coat * std::get<0>(fresnel(cos, Float(m_paint.eta)));
            density += query.coat_probability * coat_density;
        }
        return {value, density};
    }

    /// The same for what lies below the coat, with directions within it, from which light leaves.
    Evaluation evaluate_substrate(const Query &query, const Vector3f &wo) const {
        UnpolarizedSpectrum value = 0.f;
        Float density = 0.f, gap = 1.f - query.cover;
        if (query.enabled[Flakes]) {
            glints::Evaluation e = m_layer.evaluate(query.footprint, vec3(query.inside), vec3(wo));
            value += query.flakes * e.value;
            density += e.pdf;
        }
        if (query.enabled[Diffuse]) {
            Float cosine = gap * wo.z() * dr::InvPi<Float>;
            value += query.diffuse * cosine / (1.f - m_coat.inner() * query.albedo());
            // Only directions that leave the coat are drawn: of the cosine lobe they are the share 1 / eta^2.
            density += query.diffuse_probability * cosine * m_paint.eta * m_paint.eta;
        }
        if (query.enabled[Glossy]) {
            auto [glossy, glossy_density] = evaluate_rough(base_distribution(), query.inside, wo);
            value += query.glossy * (gap * glossy);
            density += (1.f - query.diffuse_probability) * gap * glossy_density;
        }
        return {value, density};
    }

    /// A rough mirror without Fresnel term: f cos theta_o, and the density of `wo`.
    static std::pair<Float, Float> evaluate_rough(const Distribution &distribution, const Vector3f &wi,
                                                  const Vector3f &wo) {
        Vector3f h = dr::normalize(wi + wo);
        Float cos = dr::dot(wo, h);
        if (!(cos > 0.f))
            return {0.f, 0.f};
        Float value = distribution.eval(h) * distribution.G(wi, wo, h) / (4.f * wi.z());
        return {value, distribution.pdf(wi, h) / (4.f * cos)};
    }

    Distribution coat_distribution() const { return {MicrofacetType::Beckmann, m_paint.coat_roughness}; }
    Distribution base_distribution() const { return {MicrofacetType::Beckmann, m_paint.base_roughness}; }

    // ---- sampling ----------------------------------------------------------------------------------------------------

    using Sampled = std::pair<BSDFSample3f, Spectrum>;

    Sampled sample_coat(const Query &query, const Point2f &u, BSDFSample3f &bs) const {
        if (!clear()) {
            Vector3f wo = reflect(query.wi, std::get<0>(coat_distribution().sample(query.wi, u)));
            return above_horizon(wo) ? finish(query, Coat, wo, bs) : Sampled(bs, 0.f);
        }
        bs.wo = reflect(query.wi);
        bs.pdf = query.coat_probability;
        bs.sampled_type = +BSDFFlags::DeltaReflection;
        bs.sampled_component = Coat;
        return {bs, depolarizer<Spectrum>(UnpolarizedSpectrum(query.coat_reflectance / bs.pdf))};
    }

    /// Draws a texel: a flake, or the base in a gap. The direction is one within the coat.
    std::pair<Component, Vector3f> sample_substrate(const Query &query, Float u1, const Point2f &u2) const {
        glints::FlakeSample s = m_layer.sample(query.footprint, vec3(query.inside), u1, u2.x(), u2.y());
        if (s.drawn == glints::Drawn::Flake)
            return {query.enabled[Flakes] ? Flakes : None, Vector3f(s.wo.x, s.wo.y, s.wo.z)};
        if (s.drawn == glints::Drawn::Nothing)
            return {None, 0.f};
        if (u1 < query.diffuse_probability)
            return {query.enabled[Diffuse] ? Diffuse : None, refracted(warp::square_to_cosine_hemisphere(u2))};
        return {Glossy, reflect(query.inside, std::get<0>(base_distribution().sample(query.inside, u2)))};
    }

    Sampled finish(const Query &query, Component component, const Vector3f &wo, BSDFSample3f &bs) const {
        auto [value, density] = evaluate(query, wo);
        if (!(density > 0.f))
            return {bs, 0.f};
        bs.wo = wo;
        bs.pdf = density;
        bs.sampled_type = +type_of(component);
        bs.sampled_component = component;
        return {bs, depolarizer<Spectrum>(value / density)};
    }

    static glints::Vec3 vec3(const Vector3f &v) { return {v.x(), v.y(), v.z()}; }

    glints::Footprint footprint(const SurfaceInteraction3f &si) const {
        m_warnings.check(si);
        return m_uv_footprint(si.uv, si.duv_dx, si.duv_dy);
    }

    Parameters m_parameters;
    PaintParameters m_paint;
    glints::FlakeLayer m_layer;
    UvFootprint m_uv_footprint;
    CoatReflectance m_coat;
    ref<Texture> m_flake_reflectance, m_base_color, m_base_specular;
    uint32_t m_width, m_height;
    InputWarnings<Float, Spectrum> m_warnings;
};

template <typename Float, typename Spectrum>
ref<Object> make_paint(void *, const Properties &props) {
    return new CarPaint<Float, Spectrum>(props);
}

} // namespace glints_mitsuba

extern "C" MI_EXPORT void init_plugin(std::string_view name, mitsuba::PluginRegisterFn fn) {
    using namespace glints_mitsuba;
    fn(name, "scalar_rgb", ObjectType::BSDF, make_paint<float, Color<float, 3>>);
    fn(name, "scalar_spectral", ObjectType::BSDF, make_paint<float, Spectrum<float, 4>>);
    fn(name, "scalar_spectral_polarized", ObjectType::BSDF, make_paint<float, MuellerMatrix<Spectrum<float, 4>>>);
    refuse_other_variants(name, fn, ObjectType::BSDF);
}
