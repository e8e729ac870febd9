#include "abi.h"

#include "timer.h"

#include <chrono>
#include <cmath>
#include <mitsuba/core/warp.h>
#include <mitsuba/render/bsdf.h>
#include <random>
#include <string>
#include <vector>

using namespace mitsuba;

namespace {

using Float = float;
using Spectrum3 = Color<float, 3>;
using Bsdf = BSDF<Float, Spectrum3>;
using SurfaceInteraction3f = SurfaceInteraction<Float, Spectrum3>;
using Vector3f = Vector<Float, 3>;
using Point2f = Point<Float, 2>;
using Vector2f = Vector<Float, 2>;

/// One call's arguments.
struct Query {
    SurfaceInteraction3f si;
    Vector3f wo;
    Float u1;
    Point2f u2;
};

class Random {
public:
    explicit Random(uint32_t seed) : m_engine(seed) {}
    Float next_1d() { return m_uniform(m_engine); }
    Point2f next_2d() {
        Float x = next_1d();
        return {x, next_1d()};
    }

private:
    std::mt19937 m_engine;
    std::uniform_real_distribution<Float> m_uniform{0.f, 1.f};
};

Query random_query(const Bsdf &bsdf, const GlintsTimerSettings &settings, Random &random) {
    Query q;
    q.si = dr::zeros<SurfaceInteraction3f>();
    q.si.t = 1.f;
    q.si.sh_frame = Frame<Float>(Vector3f(0.f, 0.f, 1.f));
    q.si.n = Normal<Float, 3>(0.f, 0.f, 1.f);
    q.si.uv = random.next_2d();
    q.si.duv_dx = Vector2f(settings.footprint_width_u, 0.f);
    q.si.duv_dy = Vector2f(0.f, settings.footprint_width_v);
    q.si.wi = warp::square_to_uniform_cone(random.next_2d(), std::cos(settings.max_angle_wi));
    q.u1 = random.next_1d();
    q.u2 = random.next_2d();
    q.wo = warp::square_to_uniform_hemisphere(random.next_2d());
    if (random.next_1d() < settings.sampled_wo) {
        Float u1 = random.next_1d();
        Vector3f sampled = bsdf.sample(BSDFContext(), q.si, u1, random.next_2d()).first.wo;
        if (sampled.z() > 0.f)
            q.wo = sampled;
    }
    return q;
}

/// Nanoseconds per query of the fastest of several passes. `call` returns a number, to be summed up.
template <typename Call>
double fastest_pass(const std::vector<Query> &queries, uint32_t repetitions, double &checksum, const Call &call) {
    using Clock = std::chrono::steady_clock;
    double best = INFINITY;
    for (uint32_t pass = 0; pass < repetitions; ++pass) {
        Clock::time_point start = Clock::now();
        Float sum = 0.f;
        for (const Query &q : queries)
            sum += call(q);
        std::chrono::duration<double, std::nano> elapsed = Clock::now() - start;
        best = std::min(best, elapsed.count() / queries.size());
        checksum += sum;
    }
    return best;
}

GlintsTimerTimings measure(const Bsdf &bsdf, const GlintsTimerSettings &settings) {
    Random random(settings.seed);
    std::vector<Query> queries;
    queries.reserve(settings.interactions);
    for (uint32_t i = 0; i < settings.interactions; ++i)
        queries.push_back(random_query(bsdf, settings, random));

    GlintsTimerTimings t = {};
    BSDFContext ctx;
    auto time = [&](const auto &call) { return fastest_pass(queries, settings.repetitions, t.checksum, call); };
    t.overhead_ns = time([&](const Query &q) { return q.si.uv.x() + q.wo.z() + q.u2.x(); });
    t.eval_ns = time([&](const Query &q) { return bsdf.eval(ctx, q.si, q.wo).x(); });
    t.pdf_ns = time([&](const Query &q) { return bsdf.pdf(ctx, q.si, q.wo); });
    t.eval_pdf_ns = time([&](const Query &q) {
        auto [value, pdf] = bsdf.eval_pdf(ctx, q.si, q.wo);
        return value.x() + pdf;
    });
    t.sample_ns = time([&](const Query &q) { return bsdf.sample(ctx, q.si, q.u1, q.u2).first.pdf; });

    size_t valid = 0;
    for (const Query &q : queries)
        valid += bsdf.sample(ctx, q.si, q.u1, q.u2).first.pdf > 0.f;
    t.valid_samples = double(valid) / queries.size();
    return t;
}

thread_local std::string last_error;

} // namespace

const char *glints_time_bsdf(void *object, const GlintsTimerSettings *settings, GlintsTimerTimings *timings) {
    try {
        auto *bsdf = dynamic_cast<Bsdf *>(static_cast<Object *>(object));
        if (!bsdf)
            throw std::runtime_error("glints_time_bsdf: not a BSDF of the variant scalar_rgb");
        if (settings->interactions == 0 || settings->repetitions == 0)
            throw std::runtime_error("glints_time_bsdf: interactions and repetitions must be positive");
        *timings = measure(*bsdf, *settings);
        return nullptr;
    } catch (const std::exception &e) {
        last_error = e.what();
        return last_error.c_str();
    }
}
