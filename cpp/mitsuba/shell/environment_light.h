// A scene's environment as a mixture of spherical Gaussians, with the light of every lobe.
#pragma once

#include "prefiltered_bsdf.h"

#include <algorithm>
#include <mitsuba/core/logger.h>
#include <mitsuba/core/spectrum.h>
#include <mitsuba/core/timer.h>
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/records.h>
#include <mitsuba/render/scene.h>
#include <mitsuba/render/shape.h>
#include <optional>
#include <unordered_map>
#include <vector>

namespace glints_mitsuba {

/// Fitted to directions that the emitter itself draws, on a regular grid of its random numbers: any environment, whatever
/// its resolution, and bright spots get many. Light is kept in every colour: RGB, or the spectrum every 5 nm, as
/// Mitsuba's own tables have it.
template <typename Float, typename Spectrum>
class EnvironmentLight {
public:
    MI_IMPORT_TYPES(Scene, Emitter, BSDF)
    using Sides = PrefilteredSides<Float, Spectrum>;

    EnvironmentLight(const char *owner, const Scene *scene, uint32_t lobes, float epsilon, uint32_t candidates)
        : m_emitter(const_cast<Emitter *>(scene->environment())) {
        find_bsdfs(owner, scene);
        mitsuba::Timer timer;
        Samples samples = draw();
        double total = 0.;
        for (float weight : samples.weights)
            total += weight;
        if (!(total > 0.))
            return; // black: nothing to reflect, by either way
        m_mixture.emplace(glints::Environment::fit(samples.directions, samples.weights, lobes, epsilon, candidates));
        m_energies = m_mixture->energies(samples.directions, samples.values, Channels);
        double residual = m_mixture->residual(samples.directions, samples.weights, samples.radiances);
        using mitsuba::ClassName, mitsuba::Info;
        Log(Info,
            "%s: environment as %u spherical Gaussians, fitted in %s; %.1f %% of its light is not where the map has "
            "it.",
            owner, m_mixture->lobe_count(), mitsuba::util::time_string((float) timer.value(), true), 100. * residual);
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
    static constexpr uint32_t Channels = mitsuba::is_spectral_v<UnpolarizedSpectrum> ? MI_CIE_SAMPLES : 3;
    static constexpr uint32_t GridSide = 128; ///< 16384 directions

    struct Samples {
        std::vector<float> directions, weights, radiances, values;
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
