// Fresnel term and colour of the flakes: what a renderer multiplies the glint filters' values by.
#pragma once

#include "parameters.h"

#include <mitsuba/render/fresnel.h>
#include <mitsuba/render/ior.h>
#include <mitsuba/render/texture.h>

namespace glints_mitsuba {

template <typename Float, typename Spectrum>
class Reflectance {
public:
    MI_IMPORT_TYPES(Texture)

    Reflectance(const mitsuba::Properties &props, const Parameters &parameters)
        : m_interface(parameters.interface), m_material(parameters.material), m_ior(parameters.ior) {
        if (m_interface == Interface::Material) {
            std::tie(m_eta, m_k) = mitsuba::complex_ior_from_file<Spectrum, Texture>(m_material);
        } else if (m_interface == Interface::EtaK) {
            m_eta = props.get_unbounded_texture<Texture>("eta");
            m_k = props.get_unbounded_texture<Texture>("k");
        }
        if (props.has_property("specular_reflectance"))
            m_specular_reflectance = props.get_texture<Texture>("specular_reflectance");
    }

    /// Reflected share of the light that meets a flake at the angle with cosine `cos_theta`.
    UnpolarizedSpectrum eval(const SurfaceInteraction3f &si, Float cos_theta) const {
        UnpolarizedSpectrum result = fresnel(si, cos_theta);
        if (m_specular_reflectance)
            result *= m_specular_reflectance->eval(si);
        return result;
    }

    void traverse(mitsuba::TraversalCallback *callback) {
        using mitsuba::ParamFlags;
        if (m_specular_reflectance)
            callback->put("specular_reflectance", m_specular_reflectance, ParamFlags::Differentiable);
        if (m_eta)
            callback->put("eta", m_eta, ParamFlags::Differentiable | ParamFlags::Discontinuous);
        if (m_k)
            callback->put("k", m_k, ParamFlags::Differentiable | ParamFlags::Discontinuous);
    }

    std::string to_string() const {
        std::ostringstream out;
        if (m_interface == Interface::None)
            out << "  fresnel = none";
        else if (m_interface == Interface::Dielectric)
            out << "  ior = " << m_ior;
        else
            out << "  eta = " << mitsuba::string::indent(m_eta) << ",\n  k = " << mitsuba::string::indent(m_k);
        if (m_specular_reflectance)
            out << ",\n  specular_reflectance = " << mitsuba::string::indent(m_specular_reflectance);
        return out.str();
    }

private:
    UnpolarizedSpectrum fresnel(const SurfaceInteraction3f &si, Float cos_theta) const {
        switch (m_interface) {
        case Interface::None:
            return 1.f;
        case Interface::Dielectric:
            return std::get<0>(mitsuba::fresnel(cos_theta, Float(m_ior)));
        default:
            return mitsuba::fresnel_conductor(UnpolarizedSpectrum(cos_theta),
                                              dr::Complex<UnpolarizedSpectrum>(m_eta->eval(si), m_k->eval(si)));
        }
    }

    Interface m_interface;
    std::string m_material;
    float m_ior;
    mitsuba::ref<Texture> m_eta, m_k;
    mitsuba::ref<Texture> m_specular_reflectance; ///< null: 1
};

} // namespace glints_mitsuba
