// A scene's environment as a mixture of spherical Gaussians, with the light of every lobe.
#pragma once

#include "prefiltered_bsdf.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <drjit/tensor.h>
#include <mitsuba/core/logger.h>
#include <mitsuba/core/spectrum.h>
#include <mitsuba/core/timer.h>
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/records.h>
#include <mitsuba/render/scene.h>
#include <mitsuba/render/shape.h>
#include <optional>
#include <string>
#include <typeinfo>
#include <unordered_map>
#include <vector>

namespace glints_mitsuba {

/// How an environment is made into lobes.
struct EnvironmentOptions {
    uint32_t lobes = 128;
    float epsilon = .3f;
    uint32_t candidates = 8;
    std::string file;                         ///< for messages
    std::optional<glints::Environment> saved; ///< of the file, in the emitter's frame; empty: fit in place
};

/// A scene's environment as a mixture of spherical Gaussians.
///
/// How lobes share light: everything an environment may be, its `scale` and its `to_world`.
///
/// - The lobes come from a file, or are fitted to the picture of an `envmap` as `glints environment` does it, in the emitter's
///   own frame, and then turned by `to_world`. Other environments, and pictures in spectral variants (which store no
///   colours), are fitted to directions that the emitter draws.
/// - The light of the lobes is always the emitter's own, of directions that it draws on a regular grid of its random numbers:
///   any environment, whatever its resolution, and bright spots get many. In every colour: RGB, or the spectrum every
///   5 nm, as Mitsuba's own tables have it. So `scale` needs nothing from the file.
/// - Lobes from a file have to lie where the emitter's light does: no more light elsewhere than in the map that the file
///   was made from, up to `Tolerance`.
template <typename Float, typename Spectrum>
class EnvironmentLight {
public:
    MI_IMPORT_TYPES(Scene, Emitter, BSDF)
    using Sides = PrefilteredSides<Float, Spectrum>;

    EnvironmentLight(const char *owner, const Scene *scene, const EnvironmentOptions &options)
        : m_emitter(const_cast<Emitter *>(scene->environment())) {
        find_bsdfs(owner, scene);
        mitsuba::Timer timer;
        Samples samples = draw();
        double total = 0.;
        for (float weight : samples.weights)
            total += weight;
        if (!(total > 0.))
            return; // black: nothing to reflect, by either way
        m_mixture.emplace(options.saved ? in_world(owner, *options.saved) : fitted(owner, samples, options));
        m_energies = m_mixture->energies(samples.directions, samples.values, Channels);
        double residual = m_mixture->residual(samples.directions, samples.weights, samples.radiances);
        if (options.saved)
            check_place(owner, options, residual);
        using mitsuba::ClassName, mitsuba::Info;
        Log(Info,
            "%s: environment as %u spherical Gaussians, %s in %s; %.1f %% of its light is not where the map has it.",
            owner, m_mixture->lobe_count(), options.saved ? "loaded and checked" : "fitted",
            mitsuba::util::time_string((float) timer.value(), true), 100. * residual);
    }

    const Emitter *emitter() const { return m_emitter.get(); }

    /// null: the environment is black
    const glints::Environment *mixture() const { return m_mixture ? &*m_mixture : nullptr; }

    /// The radiance of a lobe, integrated over directions.
    UnpolarizedSpectrum energy(uint32_t lobe, const Wavelength &wavelengths) const {
        const float *channels = &m_energies[lobe * Channels];
        UnpolarizedSpectrum result;
        for (size_t i = 0; i < result.size(); ++i) {
            if constexpr (mitsuba::is_spectral_v<UnpolarizedSpectrum>) {
                float x = (wavelengths[i] - MI_CIE_MIN) * ((Channels - 1) / (MI_CIE_MAX - MI_CIE_MIN));
                x = std::clamp(x, 0.f, Channels - 1.f);
                uint32_t k = std::min((uint32_t) x, Channels - 2);
                result[i] = channels[k] + (x - k) * (channels[k + 1] - channels[k]);
            } else {
                result[i] = channels[i];
            }
        }
        return result;
    }

    Sides sides(const BSDF *bsdf) const {
        auto found = m_bsdfs.find(bsdf);
        // Not among the scene's shapes: inside an instanced group.
        return found != m_bsdfs.end() ? found->second.sides : Sides::of(const_cast<BSDF *>(bsdf));
    }

private:
    /// Of all light, more than directions drawn instead of pixels make in the residual.
    static constexpr double Tolerance = .03;

    static constexpr uint32_t Channels = mitsuba::is_spectral_v<UnpolarizedSpectrum> ? MI_CIE_SAMPLES : 3;
    static constexpr uint32_t GridSide = 128; ///< 16384 directions

    struct Samples {
        std::vector<float> directions, weights, radiances, values;
    };

    glints::Environment fitted(const char *owner, const Samples &samples, const EnvironmentOptions &options) const {
        if constexpr (!mitsuba::is_spectral_v<UnpolarizedSpectrum>) {
            Picture picture;
            if (m_emitter->class_name() == "EnvironmentMapEmitter")
                const_cast<Emitter *>(m_emitter.get())->traverse(&picture); // looks, only
            if (picture.height > 0)
                return in_world(owner,
                                glints::Environment::fit_map(picture.width, picture.height, picture.rgb, options.lobes,
                                                             options.epsilon, options.candidates));
        }
        return glints::Environment::fit(samples.directions, samples.weights, options.lobes, options.epsilon,
                                        options.candidates);
    }

    /// Lobes in the emitter's frame as they are in the world.
    glints::Environment in_world(const char *owner, const glints::Environment &local) const {
        using mitsuba::ClassName, mitsuba::Error;
        auto to_world = m_emitter->world_transform();
        std::array<Vector3f, 3> axes;
        for (int i = 0; i < 3; ++i) {
            Vector3f axis(0.f);
            axis[i] = 1.f;
            axes[i] = to_world * axis;
        }
        for (int i = 0; i < 3; ++i)
            if (std::abs(dr::norm(axes[i]) - 1.f) > 1e-3f || std::abs(dr::dot(axes[i], axes[(i + 1) % 3])) > 1e-3f)
                Throw("%s: environment_prefilter: \"to_world\" of the scene's environment scales or shears; its light "
                      "has no "
                      "direction then. Give it rotations alone.",
                      owner);
        auto vec3 = [](const Vector3f &v) { return glints::Vec3{v.x(), v.y(), v.z()}; };
        return local.turned(vec3(axes[0]), vec3(axes[1]), vec3(axes[2]));
    }

    void check_place(const char *owner, const EnvironmentOptions &options, double residual) const {
        using mitsuba::ClassName, mitsuba::Error;
        double expected = options.saved->saved_residual();
        if (residual > expected + Tolerance)
            Throw(
                "%s: parameter \"environment_file\": \"%s\" was made from another environment than the scene has: "
                "%.1f "
                "%% of the scene's light is not where the file's lobes are, and %.1f %% of its map \"%s\". Make it "
                "from the map of the scene's envmap, with `glints environment`; the emitter's to_world and scale are "
                "taken into account.",
                owner, options.file, 100. * residual, 100. * expected, options.saved->map_name());
    }

    /// The radiances of an `envmap`, without `scale`, and without the columns that continue it to the left and to the right.
    class Picture final : public mitsuba::TraversalCallback {
    public:
        uint32_t width = 0, height = 0;
        std::vector<float> rgb;

    protected:
        using Tensor = dr::Tensor<mitsuba::DynamicBuffer<Float>>;

        void put_value(std::string_view name, void *value, uint32_t, const std::type_info &type) override {
            if (name != "data" || type != typeid(Tensor))
                return;
            auto &data = *static_cast<Tensor *>(value);
            if (data.ndim() != 3 || data.shape(1) < 4 || data.shape(2) != 3)
                return;
            height = (uint32_t) data.shape(0);
            width = (uint32_t) data.shape(1) - 2;
            const Float *pixels = data.array().data();
            for (uint32_t row = 0; row < height; ++row) {
                const Float *begin = pixels + 3 * (size_t(row) * (width + 2) + 1);
                rgb.insert(rgb.end(), begin, begin + 3 * width);
            }
        }
        void put_object(std::string_view, mitsuba::Object *, uint32_t) override {}
    };

    Samples draw() const {
        Samples samples;
        for (uint32_t i = 0; i < GridSide * GridSide; ++i) {
            Point2f u((i % GridSide + .5f) / GridSide, (i / GridSide + .5f) / GridSide);
            Interaction3f anywhere = dr::zeros<Interaction3f>();
            auto [ds, unused] = m_emitter->sample_direction(anywhere, u);
            Float inv = dr::rcp(ds.pdf * (GridSide * GridSide));
            if (!(ds.pdf > 0.f) || !std::isfinite(inv))
                continue;
            size_t begin = samples.values.size();
            float radiance = 0.f;
            if constexpr (mitsuba::is_spectral_v<UnpolarizedSpectrum>)
                radiance = spectrum(ds.d, samples.values);
            else
                radiance = colour(ds.d, samples.values);
            for (size_t k = begin; k < samples.values.size(); ++k)
                samples.values[k] *= inv;
            Vector3f d = dr::normalize(ds.d);
            samples.directions.insert(samples.directions.end(), {d.x(), d.y(), d.z()});
            samples.radiances.push_back(radiance);
            samples.weights.push_back(radiance * inv);
        }
        return samples;
    }

    /// Radiance from a direction, and its luminance.
    float colour(const Vector3f &d, std::vector<float> &values) const {
        SurfaceInteraction3f si = dr::zeros<SurfaceInteraction3f>();
        si.wi = -d;
        UnpolarizedSpectrum rgb = unpolarized_spectrum(m_emitter->eval(si));
        values.insert(values.end(), {rgb[0], rgb[1], rgb[2]});
        return std::max(0.f, mitsuba::luminance(rgb, si.wavelengths));
    }

    /// The same for all wavelengths of the table, as many at a time as a spectrum holds.
    float spectrum(const Vector3f &d, std::vector<float> &values) const {
        SurfaceInteraction3f si = dr::zeros<SurfaceInteraction3f>();
        si.wi = -d;
        const size_t width = dr::size_v<UnpolarizedSpectrum>;
        float luminance = 0.f;
        for (size_t first = 0; first < Channels; first += width) {
            for (size_t i = 0; i < width; ++i)
                si.wavelengths[i] = wavelength(std::min(first + i, size_t(Channels - 1)));
            UnpolarizedSpectrum radiance = unpolarized_spectrum(m_emitter->eval(si));
            for (size_t i = 0; i < width && first + i < Channels; ++i) {
                values.push_back(radiance[i]);
                Float y = mitsuba::cie1931_y(Float(si.wavelengths[i]));
                luminance += radiance[i] * y / Channels;
            }
        }
        return std::max(0.f, luminance);
    }

    static float wavelength(size_t channel) {
        return MI_CIE_MIN + (MI_CIE_MAX - MI_CIE_MIN) * (float) channel / (Channels - 1);
    }

    void find_bsdfs(const char *owner, const Scene *scene) {
        std::string without;
        for (const auto &shape : scene->shapes()) {
            BSDF *bsdf = const_cast<BSDF *>(shape->bsdf());
            if (!bsdf || m_bsdfs.count(bsdf))
                continue;
            Sides sides = Sides::of(bsdf);
            m_bsdfs.emplace(bsdf, Known{bsdf, sides});
            if (!sides.front && !sides.back && has_flag(bsdf->flags(), mitsuba::BSDFFlags::NeedsDifferentials))
                without += (without.empty() ? "\"" : ", \"") + std::string(bsdf->id()) + "\"";
        }
        using mitsuba::ClassName, mitsuba::Warn;
        if (!without.empty())
            Log(Warn,
                "%s: environment_prefilter: the materials %s have no range queries of their distribution of normals, "
                "or are nested in an adapter other than \"twosided\"; they reflect the environment unprefiltered. "
                "(Said once for each scene.)",
                owner, without);
    }

    /// The reference keeps the address from being used for another BSDF.
    struct Known {
        mitsuba::ref<BSDF> bsdf;
        Sides sides;
    };

    mitsuba::ref<Emitter> m_emitter;
    std::optional<glints::Environment> m_mixture;
    std::vector<float> m_energies; ///< lobe by lobe
    std::unordered_map<const BSDF *, Known> m_bsdfs;
};

} // namespace glints_mitsuba
