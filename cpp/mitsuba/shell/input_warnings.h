// What can be wrong with a scene although every parameter is right: warnings that a BSDF gives once, while rendering.
#pragma once

#include "footprint_scope.h"

#include <array>
#include <atomic>
#include <mitsuba/core/logger.h>
#include <mitsuba/render/interaction.h>
#include <mitsuba/render/shape.h>
#include <string>
#include <typeinfo>

namespace glints_mitsuba {

/// Looks into a shape's parameters: is it a mesh that was loaded without texture coordinates?
///
/// Mitsuba then takes the barycentric coordinates of each triangle for uv. (Its class `Mesh` could answer, but the
/// wheel lacks a header that it needs.)
template <typename Float>
class TexcoordFinder final : public mitsuba::TraversalCallback {
public:
    bool missing = false;

protected:
    using Buffer = mitsuba::DynamicBuffer<Float>;
    void put_value(std::string_view name, void *value, uint32_t, const std::type_info &type) override {
        if (name == "vertex_texcoords" && type == typeid(Buffer))
            missing = drjit::width(*static_cast<Buffer *>(value)) == 0;
    }
    void put_object(std::string_view, mitsuba::Object *, uint32_t) override {}
};

/// The warnings of one BSDF. Called concurrently, for every query: cheap as long as nothing is wrong.
template <typename Float, typename Spectrum>
class InputWarnings {
public:
    MI_IMPORT_TYPES(Shape)

    /// `owner` is how messages call the BSDF; `needs_footprint`: is a missing footprint worth a warning?
    InputWarnings(const std::string &owner, bool needs_footprint)
        : m_owner(owner), m_needs_footprint(needs_footprint) {}

    void check(const SurfaceInteraction3f &si) const {
        if (m_needs_footprint && !si.has_uv_partials())
            check_footprint();
        if (si.shape)
            check_uv(si.shape);
    }

private:
    void check_footprint() const {
        if (!NoFootprintScope::active() && first_time(m_warned_of_footprint))
            warn("a shading point came without a footprint (its uv partials are zero), so single texels are shown "
                 "instead of filtered ones. Mitsuba's integrators drop the ray differentials of the camera, all but "
                 "\"direct\": use \"glints_path\" instead of \"path\" or \"volpath\", or \"direct\". If you do "
                 "already, a shape with this material lacks usable uv coordinates.");
    }

    void check_uv(const Shape *shape) const {
        // A lossy set of the shapes seen: a collision costs another look at a shape, nothing else.
        std::atomic<const Shape *> &slot = m_seen[(reinterpret_cast<uintptr_t>(shape) >> 6) % m_seen.size()];
        if (slot.load(std::memory_order_relaxed) == shape)
            return;
        slot.store(shape, std::memory_order_relaxed);
        if (!shape->is_mesh())
            return;
        TexcoordFinder<Float> finder;
        const_cast<Shape *>(shape)->traverse(&finder); // hands out references, changes nothing
        if (finder.missing && first_time(m_warned_of_uv))
            warn("a mesh with this material has no uv coordinates, so every triangle shows the whole normal map in a "
                 "frame of its own. Give the mesh texture coordinates.");
    }

    static bool first_time(std::atomic<bool> &warned) {
        // The plain load keeps the cache line shared among threads once the warning is out.
        return !warned.load(std::memory_order_relaxed) && !warned.exchange(true);
    }

    void warn(const char *text) const {
        using mitsuba::ClassName, mitsuba::Warn;
        Log(Warn, "%s: %s (Said once for each BSDF.)", m_owner, text);
    }

    std::string m_owner;
    bool m_needs_footprint;
    mutable std::atomic<bool> m_warned_of_footprint{false}, m_warned_of_uv{false};
    mutable std::array<std::atomic<const Shape *>, 64> m_seen{};
};

} // namespace glints_mitsuba
