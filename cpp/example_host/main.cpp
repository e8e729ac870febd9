// Glints in a renderer of your own: load a normal map, ask for values, draw samples, check the energy.
//
//     example_host MAP [ALPHA] [FOOTPRINT] [SAMPLES]
//
// MAP is a normal map (EXR, PNG, JPEG or TIFF), ALPHA the Beckmann roughness of a flake (0.02), FOOTPRINT the width of a
// square pixel footprint in texels (16), SAMPLES how many directions are drawn (200000). Exits with 1 if the energy is off
// and with 2 if the input is unusable.
// See CMakeLists.txt beside this file for building it.

#include <glints/glints.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <random>

namespace {

using glints::Vec3;

Vec3 normalized(const Vec3 &v) {
    float length = std::sqrt(v.x * v.x + v.y * v.y + v.z * v.z);
    return {v.x / length, v.y / length, v.z / length};
}

float dot(const Vec3 &a, const Vec3 &b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

Vec3 reflect(const Vec3 &v, const Vec3 &h) {
    float twice = 2.f * dot(v, h);
    return {twice * h.x - v.x, twice * h.y - v.y, twice * h.z - v.z};
}

/// What a renderer knows at a shading point: where the pixel falls on the map, and the direction to the viewer.
struct ShadingPoint {
    glints::Footprint footprint;
    Vec3 wi;
};

/// The integral of `f(h)` over the projected hemisphere of half vectors, dx dy = cos(theta_h) dh, by the midpoint rule.
/// The cells are a fifth of a flake's lobe wide, for which the rule is exact up to rounding on smooth lobes.
template <typename Function>
double integrate_half_vectors(float alpha, const Function &f) {
    int cells = (int) std::ceil(10.f / alpha);
    double width = 2.0 / cells, sum = 0.0;
    for (int row = 0; row < cells; ++row)
        for (int column = 0; column < cells; ++column) {
            double x = (column + 0.5) * width - 1.0, y = (row + 0.5) * width - 1.0, r2 = x * x + y * y;
            if (r2 < 1.0)
                sum += f(Vec3{(float) x, (float) y, (float) std::sqrt(1.0 - r2)});
        }
    return sum * width * width;
}

/// Every point of the surface shows one flake: the distribution of normals integrates to one against the cosine.
bool check_distribution(const glints::Brdf &brdf, const ShadingPoint &point, float alpha) {
    const double tolerance = 0.005; // of the bins, which show lobes in limited resolution
    double integral = integrate_half_vectors(alpha, [&](const Vec3 &h) { return brdf.ndf(point.footprint, h); });
    std::printf("furnace, distribution of normals: %.4f, must be 1 within %g\n", integral, tolerance);
    return std::abs(integral - 1.0) <= tolerance;
}

/// In a uniformly bright environment (a white furnace) the reflected share of the light, without Fresnel losses, must
/// come out alike whether directions are integrated or drawn: `sample`, `pdf` and `evaluate` fit together.
bool check_energy(const glints::Brdf &brdf, const ShadingPoint &point, float alpha, int samples) {
    double integrated = integrate_half_vectors(alpha, [&](const Vec3 &h) {
        if (dot(point.wi, h) <= 0.f)
            return 0.f;
        Vec3 wo = reflect(point.wi, h); // d(wo) = 4 (wo . h) d(h)
        return brdf.value(point.footprint, point.wi, wo) * 4.f * dot(wo, h) / h.z;
    });

    std::mt19937 random(1);
    std::uniform_real_distribution<float> uniform(0.f, 1.f);
    double sum = 0.0, sum_of_squares = 0.0;
    for (int i = 0; i < samples; ++i) {
        float u1 = uniform(random), u2 = uniform(random), u3 = uniform(random);
        glints::Sample s = brdf.sample(point.footprint, point.wi, u1, u2, u3);
        double weight = s.valid ? s.value / s.pdf : 0.0; // a renderer's throughput, before Fresnel term and colour
        sum += weight;
        sum_of_squares += weight * weight;
    }
    double sampled = sum / samples;
    double error = std::sqrt((sum_of_squares / samples - sampled * sampled) / samples);
    double tolerance = 0.005 * integrated + 5.0 * error; // numerical integral, five standard errors of the samples
    std::printf("furnace, reflected energy: integrated %.4f, sampled %.4f, must agree within %.4f\n", integrated,
                sampled, tolerance);
    return std::abs(sampled - integrated) <= tolerance;
}

void print_answers(const glints::Brdf &brdf, const ShadingPoint &point) {
    glints::Statistics s = brdf.statistics();
    std::printf("%s: %.2f MB, built in %.3f s, %u bins per side\n", s.method.c_str(), s.structure_bytes * 1e-6,
                s.build_seconds, s.bins);

    glints::Sample sample = brdf.sample(point.footprint, point.wi, 0.3f, 0.6f, 0.2f);
    if (!sample.valid) {
        std::printf("sample: none; counts as zero\n");
        return;
    }
    // A renderer multiplies `value` by its own F(dot(wi, h)) and colour.
    std::printf("sample: wo (%.3f, %.3f, %.3f), density %g, value %g\n", sample.wo.x, sample.wo.y, sample.wo.z,
                sample.pdf, sample.value);
    Vec3 h = normalized({point.wi.x + sample.wo.x, point.wi.y + sample.wo.y, point.wi.z + sample.wo.z});
    std::printf("distribution of normals at its half vector: %g\n", brdf.ndf(point.footprint, h));
}

} // namespace

int main(int argc, char **argv) {
    if (argc < 2) {
        std::fprintf(stderr, "usage: %s MAP [ALPHA] [FOOTPRINT] [SAMPLES]\n", argv[0]);
        return 2;
    }
    float alpha = argc > 2 ? (float) std::atof(argv[2]) : 0.02f;
    float texels = argc > 3 ? (float) std::atof(argv[3]) : 16.f;
    int samples = argc > 4 ? std::atoi(argv[4]) : 200000;
    if (samples < 1) {
        std::fprintf(stderr, "SAMPLES is %s; it must be a positive number\n", argv[4]);
        return 2;
    }

    try {
        // Once per material.
        glints::NormalMap map = glints::NormalMap::load(argv[1]);
        glints::SurfaceOptions surface;
        surface.alpha = alpha;
        glints::Brdf brdf = glints::Brdf::inverse_bin_map(map, surface);
        std::printf("%s: %u x %u texels\n", argv[1], map.width(), map.height());

        // Once per shading point, from the renderer's uv and ray differentials; here a square in the middle of the map.
        ShadingPoint point;
        point.footprint = {0.5f, 0.5f, texels / map.width(), 0.f, 0.f, texels / map.height()};
        point.wi = normalized({0.3f, 0.1f, 1.f});

        print_answers(brdf, point);
        bool distribution_ok = check_distribution(brdf, point, alpha);
        bool energy_ok = check_energy(brdf, point, alpha, samples);
        return distribution_ok && energy_ok ? 0 : 1;
    } catch (const glints::Error &e) {
        std::fprintf(stderr, "%s\n", e.what());
        return 2;
    }
}
