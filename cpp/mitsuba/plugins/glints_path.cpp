/*
Path tracer with footprints (`glints_path`)
===========================================

A path tracer that hands the camera's ray differentials to the material of the first vertex, so that glint BSDFs (and
any other that filters textures) see the pixel's footprint there. Mitsuba's own `path` drops them. Otherwise it renders
what `path` renders: on scenes without glints both converge to the same image.

| Parameter       | Type            | Meaning                                                                           |
|-----------------|-----------------|-----------------------------------------------------------------------------------|
| `max_depth`     | integer         | Longest path in the image, -1: any. 1: directly visible light sources only;       |
|                 |                 | 2: direct illumination, and so on. (Default: -1)                                  |
| `rr_depth`      | integer         | Depth at which Russian roulette begins. (Default: 5)                              |
| `hide_emitters` | boolean         | Hide directly visible emitters. (Default: false)                                  |
| `footprint`     | string or float | Width of the footprint that materials see.                                        |
|                 |                 | `sample`: Mitsuba's convention, a pixel divided by the square root of the number  |
|                 |                 | of samples per pixel: every sample stands for its own part of the pixel. The image|
|                 |                 | converges to the unfiltered one, however biased a filter is.                      |
|                 |                 | `pixel`: one pixel, whatever the number of samples. Images with few and many      |
|                 |                 | samples have the same expectation, slightly smoother than the unfiltered one.     |
|                 |                 | A number: that many pixels, whatever the number of samples. 0 switches filtering  |
|                 |                 | off.                                                                              |
|                 |                 | (Default: `sample`)                                                               |

Guidance
--------

- `pixel` is right for convergence plots over the number of samples: with `sample` each point of the plot is another
  estimator.
- Deeper vertices have no footprint: glint BSDFs use the texel under the point there, without warning. Straight
  passages through `mask` or `null` materials do not count as vertices.
- The scale is taken from the sampler's sample count. If `samples_per_pass` (deprecated in Mitsuba) is set on this
  integrator it is accounted for; on an integrator that wraps this one (`aov`, `moment`) it is not.
- No participating media. Differentials exist for sensors that provide them, such as `perspective`.
- Variants: `scalar_rgb`, `scalar_spectral`, `scalar_spectral_polarized`.

XML:

    <integrator type="glints_path">
        <integer name="max_depth" value="6"/>
        <string name="footprint" value="pixel"/>
    </integrator>

Python:

    integrator = mi.load_dict({'type': 'glints_path', 'max_depth': 6, 'footprint': 'pixel'})
*/
#include "abi.h"

#include "footprint_scope.h"
#include "registry.h"

#include <cmath>
#include <cstdlib>
#include <mitsuba/core/ray.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/integrator.h>
#include <mitsuba/render/records.h>
#include <mitsuba/render/sampler.h>
#include <mitsuba/render/scene.h>
#include <mitsuba/render/shape.h>

namespace glints_mitsuba {

using namespace mitsuba;

/// The parameter `footprint`: how wide the footprint of a camera ray is.
class FootprintRule {
public:
    explicit FootprintRule(const Properties &props) {
        const char *name = "footprint";
        if (!props.has_property(name) || is_word(props, name, "sample"))
            return;
        m_per_sample = false;
        m_pixels = is_word(props, name, "pixel") ? 1.f : number(props, name);
        if (!std::isfinite(m_pixels) || m_pixels < 0.f)
            Throw("%s: parameter \"footprint\" is %s; it must be \"sample\", \"pixel\" or a number of pixels that is "
                  "finite and not negative.",
                  props.plugin_name(), props.as_string(name));
    }

    /// Factor on differentials that Mitsuba has shrunk for `samples` samples per pixel.
    float scale(uint32_t samples) const { return m_per_sample ? 1.f : m_pixels * std::sqrt((float) samples); }

    std::string to_string() const { return m_per_sample ? "sample" : tfm::format("%s pixels", m_pixels); }

private:
    static bool is_word(const Properties &props, const char *name, std::string_view word) {
        return props.type(name) == Properties::Type::String && props.get<std::string_view>(name) == word;
    }

    /// The value as a number, also when it comes as text; NaN for other text.
    static float number(const Properties &props, const char *name) {
        if (props.type(name) != Properties::Type::String)
            return props.get<float>(name);
        std::string text(props.get<std::string_view>(name));
        char *end = nullptr;
        float value = std::strtof(text.c_str(), &end);
        return end != text.c_str() && *end == '\0' ? value : NAN;
    }

    bool m_per_sample = true;
    float m_pixels = 1.f;
};

template <typename Float, typename Spectrum>
class GlintsPath final : public MonteCarloIntegrator<Float, Spectrum> {
public:
    MI_IMPORT_BASE(MonteCarloIntegrator, m_max_depth, m_rr_depth, m_hide_emitters, m_samples_per_pass)
    MI_IMPORT_TYPES(Scene, Sampler, Medium, EmitterPtr, BSDFPtr)

    explicit GlintsPath(const Properties &props) : Base(props), m_footprint(props) {}

    std::pair<Spectrum, Mask> sample(const Scene *scene, Sampler *sampler, const RayDifferential3f &camera_ray,
                                     const Medium *, Float *, Mask active) const override {
        MI_MASKED_FUNCTION(ProfilerPhase::SamplingIntegratorSample, active);
        if (!active || m_max_depth == 0)
            return {0.f, false};
        Walk walk(*this, scene, sampler, camera_ray);
        while (walk.step())
            ;
        return {walk.radiance, walk.visible};
    }

    std::string to_string() const override {
        return tfm::format("GlintsPath[\n  max_depth = %i,\n  rr_depth = %i,\n  footprint = %s\n]", (int) m_max_depth,
                           (int) m_rr_depth, m_footprint.to_string());
    }

    MI_DECLARE_CLASS(GlintsPath)

private:
    /// One light path, grown vertex by vertex from the camera.
    struct Walk {
        Walk(const GlintsPath &integrator, const Scene *scene, Sampler *sampler, const RayDifferential3f &camera_ray)
            : integrator(integrator), scene(scene), sampler(sampler), ray(camera_ray),
              visible(!integrator.m_hide_emitters && scene->environment() != nullptr) {
            float scale = integrator.m_footprint.scale(integrator.samples_per_pixel(sampler));
            ray.scale_differential(scale);
            ray.has_differentials = ray.has_differentials && scale > 0.f;
        }

        /// Goes on to the next vertex and gathers the light there. False: the path ends.
        bool step() {
            SurfaceInteraction3f si = intersect();
            gather_emission(si);
            if (!si.is_valid() || depth + 1 >= integrator.m_max_depth)
                return false;

            // A camera without differentials is worth a warning of the BSDF; a deeper vertex or footprint=0 is not.
            NoFootprintScope scope(!(at_camera_vertex && integrator.m_footprint.scale(1) > 0.f));
            BSDFPtr bsdf = si.bsdf(ray);
            if (has_flag(bsdf->flags(), BSDFFlags::Smooth))
                connect_to_emitter(si, bsdf);
            return scatter(si, bsdf) && survive_roulette();
        }

        SurfaceInteraction3f intersect() const {
            if (depth > 0 || !integrator.m_hide_emitters)
                return scene->ray_intersect(ray, +RayFlags::All, /* coherent = */ depth == 0);
            auto behind_emitters = integrator.skip_area_emitters(scene, ray, /* coherent = */ true);
            return behind_emitters.compute_surface_interaction(ray, +RayFlags::All);
        }

        /// Emission that the walk itself has found, weighted against what `connect_to_emitter` would have found.
        void gather_emission(const SurfaceInteraction3f &si) {
            EmitterPtr emitter = si.emitter(scene);
            if (!emitter || (depth == 0 && integrator.m_hide_emitters))
                return;
            Float weight = 1.f;
            if (!previous_was_delta) {
                DirectionSample3f ds(scene, si, previous);
                weight = power_heuristic(previous_pdf, scene->pdf_emitter_direction(previous, ds));
            }
            radiance += throughput * emitter->eval(si) * weight;
        }

        /// Light of a point on an emitter, weighted against the chance that the walk finds it by itself.
        void connect_to_emitter(const SurfaceInteraction3f &si, BSDFPtr bsdf) {
            auto [ds, emitted] = scene->sample_emitter_direction(si, sampler->next_2d(), /* test_visibility = */ true);
            if (ds.pdf == 0.f || dr::all(unpolarized_spectrum(emitted) == 0.f))
                return;
            Vector3f wo = si.to_local(ds.d);
            auto [reflected, pdf] = bsdf->eval_pdf(BSDFContext(), si, wo);
            Float weight = ds.delta ? 1.f : power_heuristic(ds.pdf, pdf);
            radiance += throughput * si.to_world_mueller(reflected, -wo, si.wi) * emitted * weight;
        }

        /// Draws the next direction. False: the material absorbs the path.
        bool scatter(const SurfaceInteraction3f &si, BSDFPtr bsdf) {
            Float u1 = sampler->next_1d();
            Point2f u2 = sampler->next_2d();
            auto [bs, weight] = bsdf->sample(BSDFContext(), si, u1, u2);
            throughput = throughput * si.to_world_mueller(weight, -bs.wo, si.wi);
            eta *= bs.eta;

            bool passes_straight = has_flag(bs.sampled_type, BSDFFlags::Null);
            visible |= !passes_straight;
            continue_along(si.spawn_ray(si.to_world(bs.wo)), passes_straight);

            previous = si;
            previous_pdf = bs.pdf;
            previous_was_delta = has_flag(bs.sampled_type, BSDFFlags::Delta);
            depth++;
            return dr::any(unpolarized_spectrum(throughput) != 0.f);
        }

        /// The offset rays of the differentials are still right behind a straight passage, and nowhere else.
        void continue_along(const Ray3f &next, bool straight) {
            at_camera_vertex &= straight;
            RayDifferential3f offsets = ray;
            ray = RayDifferential3f(next);
            if (straight && offsets.has_differentials) {
                ray.o_x = offsets.o_x, ray.o_y = offsets.o_y;
                ray.d_x = offsets.d_x, ray.d_y = offsets.d_y;
                ray.has_differentials = true;
            }
        }

        /// Ends dim paths at random. The square of `eta` undoes the radiance scale inside refracting bodies.
        bool survive_roulette() {
            Float u = sampler->next_1d();
            if (depth < integrator.m_rr_depth)
                return true;
            Float survival = std::min(Float(dr::max(unpolarized_spectrum(throughput)) * eta * eta), Float(.95f));
            throughput *= 1.f / survival;
            return u < survival;
        }

        const GlintsPath &integrator;
        const Scene *scene;
        Sampler *sampler;
        RayDifferential3f ray;

        Spectrum radiance = 0.f, throughput = 1.f;
        Float eta = 1.f;
        uint32_t depth = 0;
        bool visible; ///< for the alpha channel
        bool at_camera_vertex = true;

        Interaction3f previous = dr::zeros<Interaction3f>();
        Float previous_pdf = 1.f;
        bool previous_was_delta = true; ///< the camera: nothing else can find what its rays hit
    };

    static Float power_heuristic(Float pdf, Float other) {
        // As a ratio of densities, for squares may overflow.
        Float ratio = other / pdf;
        return pdf > 0.f ? 1.f / (1.f + ratio * ratio) : 0.f;
    }

    uint32_t samples_per_pixel(const Sampler *sampler) const {
        return std::min(sampler->sample_count(), m_samples_per_pass);
    }

    FootprintRule m_footprint;
};

template <typename Float, typename Spectrum>
ref<Object> make_path(void *, const Properties &props) {
    return new GlintsPath<Float, Spectrum>(props);
}

} // namespace glints_mitsuba

extern "C" MI_EXPORT void init_plugin(std::string_view name, mitsuba::PluginRegisterFn fn) {
    using namespace glints_mitsuba;
    fn(name, "scalar_rgb", ObjectType::Integrator, make_path<float, Color<float, 3>>);
    fn(name, "scalar_spectral", ObjectType::Integrator, make_path<float, Spectrum<float, 4>>);
    fn(name, "scalar_spectral_polarized", ObjectType::Integrator, make_path<float, MuellerMatrix<Spectrum<float, 4>>>);
    refuse_other_variants(name, fn, ObjectType::Integrator);
}
