// How `glints_path` asks a BSDF for the reflection of a whole lobe of an environment's light.
#pragma once

#include <glints/glints.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/interaction.h>
#include <string>

namespace glints_mitsuba {

namespace dr = drjit;

/// A BSDF that may average its NDF over the lobes of an environment.
template <typename Float, typename Spectrum>
class PrefilteredBSDF {
public:
    MI_IMPORT_TYPES(BSDF)

    /// What a lobe of unit energy reflects, divided by the probability of its choice, and a direction to look for
    /// shadows in.
    struct Draw {
        uint32_t lobe = 0;
        Vector3f wo = 0.f; ///< local
        Spectrum weight = 0.f;
        bool valid = false;
    };

    virtual bool prefilters() const = 0;
    /// `si.wi` is above the horizon. `z` is where the local z axis is in the world: the shading normal or, seen from
    /// behind through `twosided`, its opposite.
    virtual Draw sample_environment(const SurfaceInteraction3f &si, const Vector3f &z,
                                    const glints::Environment &environment, Float u1, const Point2f &u2) const = 0;

protected:
    ~PrefilteredBSDF() = default;
};

/// The prefiltered BSDFs on the two sides of a surface; null: none.
template <typename Float, typename Spectrum>
struct PrefilteredSides {
    using Side = const PrefilteredBSDF<Float, Spectrum> *;
    Side front = nullptr, back = nullptr;

    /// Looks at the BSDF itself, and through Mitsuba's `twosided`. Other adapters change what is reflected.
    static PrefilteredSides of(mitsuba::BSDF<Float, Spectrum> *bsdf) {
        if (Side self = side(bsdf))
            return {self, nullptr};
        if (bsdf->class_name() != "TwoSidedBRDF")
            return {};
        Nested nested;
        bsdf->traverse(&nested);
        return nested.sides;
    }

private:
    static Side side(mitsuba::Object *object) {
        Side found = dynamic_cast<Side>(object);
        return found && found->prefilters() ? found : nullptr;
    }

    /// The parameters of `twosided`: one BSDF for both sides, or one for each.
    class Nested final : public mitsuba::TraversalCallback {
    public:
        PrefilteredSides sides;

    protected:
        void put_value(std::string_view, void *, uint32_t, const std::type_info &) override {}
        void put_object(std::string_view name, mitsuba::Object *object, uint32_t) override {
            if (name == "brdf_0")
                sides = {side(object), side(object)};
            else if (name == "brdf_1")
                sides.back = side(object);
        }
    };
};

} // namespace glints_mitsuba
