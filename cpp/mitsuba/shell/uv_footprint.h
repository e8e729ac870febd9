// The one place where Mitsuba's texture coordinates and ray differentials become a footprint on the map.
#pragma once

#include "parameters.h"

namespace glints_mitsuba {

/// uv' = tiles * to_uv(uv), and its derivative applied to a pixel's footprint.
class UvFootprint {
public:
    using Point2f = mitsuba::Point<float, 2>;
    using Vector2f = mitsuba::Vector<float, 2>;

    explicit UvFootprint(const Parameters &parameters) : m_tiles(parameters.tiles), m_to_uv(parameters.to_uv) {}

    /// `uv` and its partial derivatives with respect to the pixel's x and y, as in a `SurfaceInteraction`.
    glints::Footprint operator()(const Point2f &uv, const Vector2f &duv_dx, const Vector2f &duv_dy) const {
        // `Transform * Point` is what Mitsuba's `bitmap` does: the same rounding, so the same texel.
        Point2f centre = m_tiles * (m_to_uv * uv);
        Vector2f dx = m_tiles * (m_to_uv * duv_dx);
        Vector2f dy = m_tiles * (m_to_uv * duv_dy);
        return {centre.x(), centre.y(), dx.x(), dx.y(), dy.x(), dy.y()};
    }

private:
    float m_tiles;
    mitsuba::AffineTransform<mitsuba::Point<float, 3>> m_to_uv;
};

} // namespace glints_mitsuba
