// How an integrator tells the BSDFs that a missing footprint is no accident.
//
// A glint BSDF that sees no footprint warns, because stock integrators other than `direct` silently drop the ray
// differentials it lives from. `glints_path` may have none behind the first bounce, by choice.
#pragma once

namespace glints_mitsuba {

/// While it lives, glint BSDFs called by this thread take a missing footprint for granted.
class __attribute__((visibility("default"))) NoFootprintScope {
public:
    explicit NoFootprintScope(bool without_footprint);
    ~NoFootprintScope();
    NoFootprintScope(const NoFootprintScope &) = delete;
    NoFootprintScope &operator=(const NoFootprintScope &) = delete;

    /// Does the calling thread stand in such a scope?
    static bool active();

private:
    bool m_outer;
};

} // namespace glints_mitsuba
