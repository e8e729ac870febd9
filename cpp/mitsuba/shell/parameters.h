// The parameters that all glint BSDFs share, read from a scene and checked. Nothing here depends on the variant.
//
// Every message names the plugin and the parameter, and the file where there is one, and says what to do.
#pragma once

#include "registry.h"

#include <glints/glints.h>
#include <mitsuba/core/properties.h>
#include <mitsuba/core/transform.h>
#include <string>
#include <utility>

namespace glints_mitsuba {

/// What decides the Fresnel term.
enum class Interface {
    None,       ///< no Fresnel term: every flake reflects everything
    Material,   ///< a conductor of Mitsuba's material library
    EtaK,       ///< a conductor given by `eta` and `k`
    Dielectric, ///< reflection at a dielectric, `int_ior` and `ext_ior`
};

struct GLINTS_MITSUBA_API Parameters {
    explicit Parameters(const mitsuba::Properties &props);

    std::string plugin;
    std::string filename; ///< as the file resolver found it; empty: not given
    glints::Encoding encoding = glints::Encoding::Automatic;
    bool flip_y = false;
    glints::SurfaceOptions surface;

    float tiles = 1.f;
    mitsuba::AffineTransform<mitsuba::Point<float, 3>> to_uv;

    Interface interface = Interface::None;
    std::string material; ///< for `Interface::Material`
    float ior = 1.f;      ///< for `Interface::Dielectric`: inside over outside

private:
    void read_map(const mitsuba::Properties &props);
    void read_placement(const mitsuba::Properties &props);
    void read_surface(const mitsuba::Properties &props);
    void read_masking(const mitsuba::Properties &props);
    void read_interface(const mitsuba::Properties &props);
    void read_material(const mitsuba::Properties &props);
    void read_dielectric(const mitsuba::Properties &props);
};

/// The normal map that the parameters name; an error if they name none.
GLINTS_MITSUBA_API glints::NormalMap load_map(const Parameters &parameters);

/// A plugin and, if it has one, its name in the scene: `glints_ibm "flakes"`.
GLINTS_MITSUBA_API std::string described(const mitsuba::Properties &props);

} // namespace glints_mitsuba
