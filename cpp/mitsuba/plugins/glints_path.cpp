/*
Path tracer with footprints (`glints_path`)
===========================================

A path tracer that carries the pixel's footprint along its paths, so that glint BSDFs (and any other that filters
textures) see at every vertex what part of their surface one sample stands for. Mitsuba's own `path` drops ray
differentials. Otherwise it renders what `path` renders: on scenes without glints both converge to the same image.

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
| `indirect_      | float           | Footprint behind the first bounce (Section 5.3 of Deng et al. 2022). The number   |
| footprint`      |                 | scales the spread of rough bounces; mirrors and glass pass the footprint on in any|
|                 |                 | case. 0: deeper vertices have none, glint BSDFs use the texel under the point.    |
|                 |                 | (Default: 1)                                                                      |
| `environment_   | boolean         | Light of the environment that glint BSDFs reflect is prefiltered (Section 5.4):   |
| prefilter`      |                 | their NDF is averaged over the extent of a piece of the environment, instead of   |
|                 |                 | being sampled. Far less noise, some bias. (Default: false)                        |
| `environment_   | integer         | Number of those pieces, spherical Gaussians, at most 1024. More: finer shapes of  |
| lobes`          |                 | lights, more time. (Default: 128)                                                 |
| `environment_   | string          | Instead of `environment_lobes`: a fit that `glints environment` saved from the    |
| file`           |                 | scene's environment map. Nothing is fitted then.                                  |
| `environment_   | float           | A piece extends to where its Gaussian has so many times its peak, in (0, 1).      |
| epsilon`        |                 | (Default: 0.3)                                                                    |
| `environment_   | integer         | Pieces that a sample considers, 1 to 64, to keep one of them by its reflection.   |
| candidates`     |                 | Each costs a range query. (Default: 8)                                            |

The footprint behind a bounce
-----------------------------

- Ray differentials (Igehy 1999) pass mirrors and refractions, with the shape's own curvature; behind a plane mirror the
  footprint is that of the mirrored camera.
- A rough bounce (glossy, diffuse, glints) spreads the footprint by the square of solid angle that one sample stands for,
  1 / pdf of the drawn direction, a side of at most 45 degrees; with `footprint` = `sample` divided by the number of samples
  per pixel, with a number of pixels times the square of that number. The spread is independent of the pixel's own
  extent: the two add as variances, and glints see one parallelogram with the sum. (See path_footprint.h.)
- With `sample` the image still converges to the unfiltered one. With `pixel` it is smoother: what a lobe reflects is seen
  through a single direction, and over all of the surface that the lobe meets, taken as flat.
- Large footprints cost time: with `glints_ibm` little, with `glints_yan16` and `glints_direct` in proportion to the texels.

Environment prefiltering
------------------------

- The environment (any kind: `envmap`, `constant`, `sunsky`) becomes a mixture of spherical Gaussians, fitted when the first
  sample of a scene is taken; the log says how long that took, and how much light the mixture has in other places than the
  map. Each direction's light is divided among the Gaussians, so energy is kept, in all colours. If the
  environment is changed afterwards, make a new integrator.
- `environment_file` saves that time, and the fit can be looked at before: `glints environment studio.exr -o studio.json
  --picture studio.png`. Its Gaussians lie in the frame of the map, and are turned by the emitter's `to_world`, which has to be a
  rotation or a mirror image. Their light is always that of the scene's emitter, so that `scale` is right by itself. A file whose
  Gaussians do not lie where the emitter's light comes from (3 % of the light more elsewhere than in the file's own map) is an
  error. In `scalar_rgb` the image is that of a fit in place, to rounding; in spectral variants, where an `envmap` holds no
  colours, a fit in place is made of directions that the emitter draws, and differs by its noise.
- At a glint BSDF one Gaussian is drawn, by its energy times a cheap NDF and among candidates by its reflection, and a
  direction from it for shadows and Fresnel term. The NDF is averaged over the rectangle of half vectors that the Gaussian's extent covers. Directions that the BSDF
  draws count nothing when they meet the environment: there is no multiple importance sampling between the two ways.
  Other emitters, other materials and the visible background are as without prefiltering.
- It needs range queries of the NDF: `glints_tensor`, `glints_direct` and `glints_unfiltered` have them, alone or in `twosided`.
  Other glint BSDFs are rendered unprefiltered, and a warning names them once.
- Measured on two crops of 20 x 20 pixels of the project's kettle (a studio of softboxes and small lamps; `glints_tensor`,
  `footprint` = `pixel`, 64 samples per pixel) against the unprefiltered image with 1536, in parts of the mean: mean bias, which
  the reference knows to 1.4 % and 0.8 %, and the root mean square over pixels of bias and of noise. Of the bias, some 0.3 and 0.1
  are the reference's noise. Without prefiltering, noise is 1.39 and 0.74.

  | lobes | epsilon | mean bias       | rms bias   | noise      |
  |-------|---------|-----------------|------------|------------|
  | 32    | 0.3     | -3.8 %,  0.0 %  | 0.33, 0.15 | 0.10, 0.19 |
  | 128   | 0.1     | -4.2 %, -4.7 %  | 0.37, 0.42 | 0.09, 0.15 |
  | 128   | 0.2     | -4.0 %, -1.7 %  | 0.33, 0.08 | 0.10, 0.17 |
  | 128   | 0.3     | -3.4 %, +0.8 %  | 0.32, 0.15 | 0.11, 0.19 |
  | 128   | 0.6     | -2.7 %, +7.1 %  | 0.39, 0.72 | 0.11, 0.23 |
  | 128   | 0.9     | -1.7 %, +13.1 % | 0.48, 1.17 | 0.13, 0.27 |
  | 256   | 0.3     | -4.2 %, +0.7 %  | 0.32, 0.14 | 0.11, 0.19 |

  So epsilon may be 0.2 to 0.3 (a box of the Gaussian's variance has 0.22): less spreads lights, more makes them points. The
  number of lobes hardly matters here, as every small lamp has its own with 32 already.
- Use it where glints reflect windows, softboxes and skies that are small against the whole of their lobe. It blurs the shapes of
  lights in nearly smooth metal: unsuitable where NDFs are narrower than the lights' pieces.

Guidance
--------

- `pixel` is right for convergence plots over the number of samples: with `sample` each point of the plot is another
  estimator.
- Straight passages through `mask` or `null` materials do not count as vertices.
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

#include "environment_light.h"
#include "footprint_scope.h"
#include "path_footprint.h"
#include "registry.h"

#include <atomic>
#include <cmath>
#include <cstdlib>
#include <memory>
#include <mitsuba/core/ray.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/integrator.h>
#include <mitsuba/render/records.h>
#include <mitsuba/render/sampler.h>
#include <mitsuba/render/scene.h>
#include <mitsuba/render/shape.h>
#include <mutex>

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

    /// The share of a pixel's side that a sample stands for.
    float width(uint32_t samples) const { return m_per_sample ? 1.f / std::sqrt((float) samples) : m_pixels; }

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
    using Environment = EnvironmentLight<Float, Spectrum>;
    using Prefiltered = PrefilteredBSDF<Float, Spectrum>;

    explicit GlintsPath(const Properties &props)
        : Base(props), m_footprint(props), m_indirect(props.get<float>("indirect_footprint", 1.f)),
          m_prefilter(props.get<bool>("environment_prefilter", false)),
          m_options{unsigned_parameter(props, "environment_lobes", 128),
                    props.get<float>("environment_epsilon", .3f),
                    unsigned_parameter(props, "environment_candidates", 8),
                    {},
                    {}} {
        auto check = [&](bool right, const char *name, const char *domain) {
            if (!right)
                Throw("%s: parameter \"%s\" is %s; it must be %s.", props.plugin_name(), name, props.as_string(name),
                      domain);
        };
        check(std::isfinite(m_indirect) && m_indirect >= 0.f, "indirect_footprint",
              "a factor that is finite and not negative, 0 to switch deeper footprints off");
        check(m_options.lobes >= 1 && m_options.lobes <= 1024, "environment_lobes",
              "a number of spherical Gaussians in [1, 1024]");
        check(m_options.candidates >= 1 && m_options.candidates <= 64, "environment_candidates",
              "a number of candidates in [1, 64]");
        check(m_options.epsilon > 0.f && m_options.epsilon < 1.f, "environment_epsilon", "in (0, 1)");
        if (props.has_property("environment_file"))
            load_environment(props, "environment_file");
    }

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
        return tfm::format("GlintsPath[\n  max_depth = %i,\n  rr_depth = %i,\n  footprint = %s,\n"
                           "  indirect_footprint = %s,\n  environment_prefilter = %s,\n  environment_lobes = %i,\n"
                           "  environment_epsilon = %s,\n  environment_file = \"%s\"\n]",
                           (int) m_max_depth, (int) m_rr_depth, m_footprint.to_string(), m_indirect, m_prefilter,
                           m_options.lobes, m_options.epsilon, m_options.file);
    }

    MI_DECLARE_CLASS(GlintsPath)

private:
    /// One light path, grown vertex by vertex from the camera.
    struct Walk {
        Walk(const GlintsPath &integrator, const Scene *scene, Sampler *sampler, const RayDifferential3f &camera_ray)
            : integrator(integrator), scene(scene), sampler(sampler), ray(camera_ray),
              visible(!integrator.m_hide_emitters && scene->environment() != nullptr),
              environment(integrator.environment(scene)),
              footprint(integrator.m_indirect * integrator.m_footprint.width(integrator.samples_per_pixel(sampler))) {
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
            footprint.meet(si, ray);
            BSDFPtr bsdf = si.bsdf(ray);
            const Prefiltered *prefiltered = prefiltered_side(si, bsdf);
            if (prefiltered)
                reflect_environment(si, *prefiltered);
            environment_is_gathered = prefiltered != nullptr;
            if (has_flag(bsdf->flags(), BSDFFlags::Smooth) && !(prefiltered && scene->emitters().size() == 1))
                connect_to_emitter(si, bsdf);
            return scatter(si, bsdf) && survive_roulette();
        }

        SurfaceInteraction3f intersect() const {
            if (depth > 0 || !integrator.m_hide_emitters)
                return scene->ray_intersect(ray, integrator.ray_flags(), /* coherent = */ depth == 0);
            auto behind_emitters = integrator.skip_area_emitters(scene, ray, /* coherent = */ true);
            return behind_emitters.compute_surface_interaction(ray, integrator.ray_flags());
        }

        /// The BSDF that gathers the environment's light by itself, seen from this side; null: light is gathered by
        /// emitter sampling and by the walk.
        const Prefiltered *prefiltered_side(const SurfaceInteraction3f &si, BSDFPtr bsdf) const {
            if (!environment)
                return nullptr;
            auto sides = environment->sides(bsdf);
            return Frame3f::cos_theta(si.wi) < 0.f ? sides.back : sides.front;
        }

        /// Light of one of the environment's lobes, averaged over its extent by the BSDF.
        void reflect_environment(const SurfaceInteraction3f &si, const Prefiltered &bsdf) {
            Float u1 = sampler->next_1d();
            Point2f u2 = sampler->next_2d();
            // As `twosided` does it: from behind, z points the other way.
            Float side = dr::sign(Frame3f::cos_theta(si.wi));
            SurfaceInteraction3f seen = si;
            seen.wi.z() *= side;
            auto drawn = bsdf.sample_environment(seen, side * si.sh_frame.n, *environment->mixture(), u1, u2);
            if (!drawn.valid || dr::all(unpolarized_spectrum(drawn.weight) == 0.f))
                return;
            Vector3f wo = drawn.wo;
            wo.z() *= side;
            if (scene->ray_test(si.spawn_ray(si.to_world(wo))))
                return;
            radiance += throughput * si.to_world_mueller(drawn.weight, -wo, si.wi) *
                        environment->energy(drawn.lobe, si.wavelengths);
        }

        /// Emission that the walk itself has found, weighted against what `connect_to_emitter` would have found.
        void gather_emission(const SurfaceInteraction3f &si) {
            EmitterPtr emitter = si.emitter(scene);
            if (!emitter || (depth == 0 && integrator.m_hide_emitters))
                return;
            if (environment_is_gathered && emitter == scene->environment())
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
            if (environment_is_gathered && ds.emitter == scene->environment())
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
            continue_along(si, bs, passes_straight);

            previous = si;
            previous_pdf = bs.pdf;
            previous_was_delta = has_flag(bs.sampled_type, BSDFFlags::Delta);
            depth++;
            return dr::any(unpolarized_spectrum(throughput) != 0.f);
        }

        /// A straight passage leaves everything about the ray's bundle as it was.
        void continue_along(const SurfaceInteraction3f &si, const BSDFSample3f &bs, bool straight) {
            at_camera_vertex &= straight;
            Ray3f next = si.spawn_ray(si.to_world(bs.wo));
            if (!straight && integrator.m_indirect > 0.f)
                footprint.bounce(si, ray, bs, next);
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

        const Environment *environment;       ///< null: nothing is prefiltered
        bool environment_is_gathered = false; ///< at the last vertex, by its prefiltered BSDF
        PathFootprint<Float, Spectrum> footprint;

        Interaction3f previous = dr::zeros<Interaction3f>();
        Float previous_pdf = 1.f;
        bool previous_was_delta = true; ///< the camera: nothing else can find what its rays hit
    };

    /// The lobes of a file, also where prefiltering is switched off: a wrong file is told when the scene is loaded.
    void load_environment(const Properties &props, const char *name) {
        refuse_together(props, name, {"environment_lobes"}, "the file has its lobes; leave one of them out");
        m_options.file = file_parameter(props, name);
        try {
            m_options.saved.emplace(
                glints::Environment::from_file(m_options.file, m_options.epsilon, m_options.candidates));
        } catch (const glints::Error &e) {
            Throw("%s: parameter \"%s\": %s", props.plugin_name(), name, e.what());
        }
        m_options.lobes = m_options.saved->lobe_count();
    }

    static Float power_heuristic(Float pdf, Float other) {
        // As a ratio of densities, for squares may overflow.
        Float ratio = other / pdf;
        return pdf > 0.f ? 1.f / (1.f + ratio * ratio) : 0.f;
    }

    uint32_t samples_per_pixel(const Sampler *sampler) const {
        return std::min(sampler->sample_count(), m_samples_per_pass);
    }

    /// With the derivatives of normals, which carry footprints over curved mirrors.
    uint32_t ray_flags() const { return +RayFlags::All | (m_indirect > 0.f ? +RayFlags::dNSdUV : 0u); }

    /// The scene's environment as this integrator prefilters it, fitted when it is first asked for; null: not at all.
    const Environment *environment(const Scene *scene) const {
        if (!m_prefilter || !scene->environment())
            return nullptr;
        const Environment *known = m_environment.load(std::memory_order_acquire);
        if (!known || known->emitter() != scene->environment()) {
            std::lock_guard<std::mutex> guard(m_mutex);
            auto fits = [&](const auto &e) { return e->emitter() == scene->environment(); };
            auto found = std::find_if(m_environments.begin(), m_environments.end(), fits);
            if (found == m_environments.end())
                found = m_environments.insert(found, std::make_unique<Environment>("glints_path", scene, m_options));
            known = found->get();
            m_environment.store(known, std::memory_order_release);
        }
        return known->mixture() ? known : nullptr;
    }

    FootprintRule m_footprint;
    float m_indirect;
    bool m_prefilter;
    EnvironmentOptions m_options;

    mutable std::mutex m_mutex;
    mutable std::vector<std::unique_ptr<Environment>> m_environments; ///< of all scenes seen, kept for other threads
    mutable std::atomic<const Environment *> m_environment{nullptr};
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
