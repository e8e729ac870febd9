// The footprint that a light path carries from vertex to vertex.
//
// A pixel's footprint is a bundle of offset rays around the path's own: the ray differentials of Igehy, "Tracing Ray
// Differentials" (1999), as rays at a finite distance, which plane mirrors then transport without error. Two offset rays
// are the camera's. A bounce off a rough surface adds two: the lobe's own spread, which is independent of where in the
// pixel the path began. Under any surface the bundle is a sum of independent displacements, whose covariance is the
// sum over the offset rays; it is handed on as the parallelogram with that covariance.
//
//   transfer     the camera's offset rays meet the tangent plane of the path's vertex. Where they meet it too obliquely (a
//                cosine of less than half the path's own) or behind, the linear differential takes their place, and for
//                the spread of rough bounces always: it may be wide, and one of its sides stands for both.
//   reflection   at the normal m = (d' - d) / |d' - d| of the path's own bounce, turned by the shape's dn/du, dn/dv times
//                the displacement; refraction likewise, m = (d' - d / eta) / |...|.
//   rough bounce the same, and the lobe's spread on the second pair: a sample drawn with density p stands for a solid
//                angle of 1 / p, a square of side 1 / sqrt(p), at most `MaxSpread`. Variances add: a pair that has
//                spread already is stretched to the root of the sum of the squares.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <mitsuba/core/ray.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/interaction.h>

namespace glints_mitsuba {

namespace dr = drjit;

template <typename Float, typename Spectrum>
class PathFootprint {
public:
    MI_IMPORT_TYPES(BSDF)

    /// Widest spread of a bounce, as a slope: 45 degrees over the whole lobe. Wider ones mean nothing on a tangent plane.
    static constexpr float MaxSpread = 1.f;

    /// `lobe_scale`: share of a lobe's width that one sample stands for.
    explicit PathFootprint(float lobe_scale) : m_lobe_scale(lobe_scale) {}

    /// Hands the footprint on `si` to `ray`, in the form in which Mitsuba computes uv partials. Before the first
    /// bounce `ray` has the camera's own differentials, and keeps them.
    void meet(const SurfaceInteraction3f &si, RayDifferential3f &ray) const {
        if (m_count == 0 || !si.is_valid())
            return;
        auto [x, y] = parallelogram(si, displacements(si, ray));
        ray.o_x = si.p + x, ray.o_y = si.p + y;
        ray.d_x = ray.d_y = ray.d;
        ray.has_differentials = true;
    }

    /// `ray` has met `si` and goes on along `next`, as the BSDF has drawn it.
    void bounce(const SurfaceInteraction3f &si, const RayDifferential3f &ray, const BSDFSample3f &bs,
                const Ray3f &next) {
        if (m_count == 0) {
            if (!ray.has_differentials)
                return;
            m_offsets[0] = {ray.o_x, ray.d_x};
            m_offsets[1] = {ray.o_y, ray.d_y};
            m_count = 2;
        }
        auto displaced = displacements(si, ray);
        bool refracts = Frame3f::cos_theta(si.wi) * Frame3f::cos_theta(bs.wo) < 0.f;
        Float eta = refracts ? dr::rcp(bs.eta) : Float(1.f);
        Vector3f m = next.d - eta * ray.d;
        Float length = dr::norm(m);
        for (size_t i = 0; i < m_count; ++i) {
            Vector3f d = m_offsets[i].d, turned = d - ray.d;
            if (length > 1e-4f) {
                Vector3f here = m / length, there = dr::normalize(here + normal_change(si, displaced[i], here));
                turned = bent(d, there, refracts, eta) - bent(ray.d, here, refracts, eta);
            }
            m_offsets[i] = {next.o + displaced[i], next.d + turned};
        }
        if (!mitsuba::has_flag(bs.sampled_type, mitsuba::BSDFFlags::Delta))
            widen(next, bs.pdf);
    }

private:
    struct OffsetRay {
        Point3f o;
        Vector3f d;
    };

    /// Where the offset rays meet the tangent plane, from the path's own point.
    std::array<Vector3f, 4> displacements(const SurfaceInteraction3f &si, const Ray3f &ray) const {
        std::array<Vector3f, 4> result{};
        for (size_t i = 0; i < m_count; ++i)
            result[i] = displacement(si, ray, m_offsets[i], /* linear = */ i >= 2);
        return result;
    }

    static Vector3f displacement(const SurfaceInteraction3f &si, const Ray3f &ray, const OffsetRay &offset,
                                 bool linear) {
        Float cos = dr::dot(si.n, ray.d), offset_cos = dr::dot(si.n, offset.d);
        Float t = dr::dot(si.n, si.p - offset.o) / offset_cos;
        if (!linear && offset_cos * cos > .5f * cos * cos && t > 0.f)
            return dr::fmadd(offset.d, t, offset.o) - si.p;
        // Igehy's transfer, Eq. 10: along the path's own ray to the plane.
        Vector3f moved = (offset.o - ray.o) + si.t * (offset.d - ray.d);
        Vector3f flat = moved - ray.d * (dr::dot(si.n, moved) / cos);
        return dr::all(dr::isfinite(flat)) ? flat : Vector3f(0.f);
    }

    /// Change of the unit normal `m`, on either side of the surface, over a displacement on the tangent plane.
    static Vector3f normal_change(const SurfaceInteraction3f &si, const Vector3f &displaced, const Vector3f &m) {
        Float a = dr::squared_norm(si.dp_du), b = dr::dot(si.dp_du, si.dp_dv), c = dr::squared_norm(si.dp_dv);
        Float inv_det = dr::rcp(a * c - b * b);
        if (!std::isfinite(inv_det))
            return 0.f;
        Float u = dr::dot(si.dp_du, displaced), v = dr::dot(si.dp_dv, displaced);
        Vector3f change = si.dn_du * ((c * u - b * v) * inv_det) + si.dn_dv * ((a * v - b * u) * inv_det);
        if (!dr::all(dr::isfinite(change)))
            return 0.f;
        // Beyond a right angle the surface has turned away.
        change *= std::min(Float(1.f), dr::rcp(std::max(dr::norm(change), Float(1e-20f))));
        return dr::dot(m, si.sh_frame.n) < 0.f ? -change : change;
    }

    /// `d`, reflected or refracted at the normal `m`; `eta` is the ratio of refractive indices, outside to inside as seen
    /// along d. Total reflection leaves the direction as it is.
    static Vector3f bent(const Vector3f &d, const Vector3f &m, bool refracts, Float eta) {
        if (!refracts)
            return d - 2.f * dr::dot(d, m) * m;
        Vector3f unit = dr::normalize(d);
        Float cos = dr::dot(unit, m), squared = 1.f - eta * eta * (1.f - cos * cos);
        if (squared < 0.f)
            return d;
        return eta * unit + (dr::copysign(dr::sqrt(squared), cos) - eta * cos) * m;
    }

    /// Adds a lobe's spread to the second pair of offset rays.
    void widen(const Ray3f &next, Float pdf) {
        Float spread = m_lobe_scale * std::min(dr::rsqrt(std::max(pdf, Float(1e-20f))), Float(MaxSpread));
        auto [x, y] = mitsuba::coordinate_system(next.d);
        const Vector3f axes[2] = {x, y};
        for (size_t i = 0; i < 2; ++i) {
            OffsetRay &offset = m_offsets[2 + i];
            Vector3f before = m_count == 4 ? Vector3f(offset.d - next.d) : Vector3f(0.f);
            if (m_count == 2)
                offset.o = next.o;
            Float old = dr::norm(before), width = std::min(std::hypot(old, spread), std::max(Float(MaxSpread), old));
            offset.d = next.d + (old > 1e-12f ? before * (width / old) : axes[i] * width);
        }
        m_count = 4;
    }

    /// Two displacements with the same covariance as all of them together.
    std::pair<Vector3f, Vector3f> parallelogram(const SurfaceInteraction3f &si,
                                                const std::array<Vector3f, 4> &displaced) const {
        if (m_count == 2)
            return {displaced[0], displaced[1]};
        auto [s, t] = mitsuba::coordinate_system(si.n);
        double ss = 0, st = 0, tt = 0;
        for (const Vector3f &d : displaced) {
            double a = dr::dot(d, s), b = dr::dot(d, t);
            ss += a * a, st += a * b, tt += b * b;
        }
        // The principal axes of the covariance.
        double half = .5 * (ss + tt), radius = std::hypot(.5 * (ss - tt), st),
               angle = .5 * std::atan2(2 * st, ss - tt);
        Float longest = (Float) std::sqrt(half + radius), shortest = (Float) std::sqrt(std::max(half - radius, 0.));
        Float cos = (Float) std::cos(angle), sin = (Float) std::sin(angle);
        return {longest * (cos * s + sin * t), shortest * (cos * t - sin * s)};
    }

    float m_lobe_scale;
    std::array<OffsetRay, 4> m_offsets{};
    size_t m_count = 0; ///< 0 before the first bounce, 2, and 4 after a rough one
};

} // namespace glints_mitsuba
