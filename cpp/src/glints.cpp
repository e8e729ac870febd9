// The host-neutral C++ API over the Rust bridge: converts plain values, and exceptions of the bridge into glints::Error.

#include <glints/glints.h>

#include <utility>

#include "glints-bridge/src/lib.rs.h"
#include "rust/cxx.h"

namespace glints {

namespace {

bridge::Vector to_bridge(const Vec3 &v) { return {v.x, v.y, v.z}; }

Vec3 from_bridge(const bridge::Vector &v) { return {v.x, v.y, v.z}; }

bridge::Footprint to_bridge(const Footprint &f) { return {{f.u, f.v}, {f.du_dx, f.dv_dx}, {f.du_dy, f.dv_dy}}; }

bridge::MapEncoding to_bridge(Encoding encoding) {
    switch (encoding) {
    case Encoding::Unsigned:
        return bridge::MapEncoding::Unsigned;
    case Encoding::Signed:
        return bridge::MapEncoding::Signed;
    default:
        return bridge::MapEncoding::Automatic;
    }
}

bridge::MaskingKind to_bridge(Masking masking) {
    switch (masking) {
    case Masking::Beckmann:
        return bridge::MaskingKind::Beckmann;
    case Masking::Explicit:
        return bridge::MaskingKind::Explicit;
    default:
        return bridge::MaskingKind::None;
    }
}

bridge::FlakeDistribution to_bridge(Distribution distribution) {
    return distribution == Distribution::Ggx ? bridge::FlakeDistribution::Ggx : bridge::FlakeDistribution::Beckmann;
}

bridge::StructureKind to_bridge(Structure structure) {
    switch (structure) {
    case Structure::Compact:
        return bridge::StructureKind::Compact;
    case Structure::Paper:
        return bridge::StructureKind::Paper;
    default:
        return bridge::StructureKind::Automatic;
    }
}

bridge::BinningKind to_bridge(Binning binning) {
    switch (binning) {
    case Binning::Projected:
        return bridge::BinningKind::Projected;
    case Binning::EqualSolidAngle:
        return bridge::BinningKind::EqualSolidAngle;
    default:
        return bridge::BinningKind::Automatic;
    }
}

bridge::Surface to_bridge(const SurfaceOptions &o) {
    return {to_bridge(o.distribution), o.alpha,           o.normalization == Normalization::Projected,
            to_bridge(o.masking),      o.masking_alpha_u, o.masking_alpha_v};
}

bridge::InterpolationOptions to_bridge(const InterpolationOptions &o) {
    return {o.interpolation == Interpolation::Bilinear, o.refinement};
}

bridge::FilterOptions to_bridge(const FilterOptions &o) {
    return {o.filter == FootprintFilter::Gaussian, o.footprint_sigma};
}

bridge::TensorOptions to_bridge(const TensorOptions &o) {
    return {o.rank, o.error, o.resolution, o.stride, o.published};
}

Drawn from_bridge(bridge::Drawn drawn) {
    switch (drawn) {
    case bridge::Drawn::Flake:
        return Drawn::Flake;
    case bridge::Drawn::Gap:
        return Drawn::Gap;
    default:
        return Drawn::Nothing;
    }
}

Distribution from_bridge(bridge::FlakeDistribution distribution) {
    return distribution == bridge::FlakeDistribution::Ggx ? Distribution::Ggx : Distribution::Beckmann;
}

Statistics from_bridge(const bridge::Statistics &s) {
    Statistics statistics{};
    statistics.method = std::string(s.method);
    statistics.width = s.width;
    statistics.height = s.height;
    statistics.alpha = s.alpha;
    statistics.distribution = from_bridge(s.distribution);
    statistics.structure_bytes = s.structure_bytes;
    statistics.build_seconds = s.build_seconds;
    statistics.bins = s.bins;
    statistics.refinement = s.refinement;
    statistics.refinement_step = s.refinement_step;
    statistics.masking_alpha_u = s.masking_alpha_u;
    statistics.masking_alpha_v = s.masking_alpha_v;
    statistics.warning = std::string(s.warning);
    return statistics;
}

// A Rust string holds nothing else.
rust::Str utf8(const std::string &filename, const char *parameter = "filename") {
    try {
        return rust::Str(filename);
    } catch (const std::invalid_argument &) {
        throw Error(std::string(parameter) + " \"" + filename + "\": is not valid UTF-8; rename the file");
    }
}

rust::Slice<const float> slice(const std::vector<float> &values) { return {values.data(), values.size()}; }

// Calls a constructor of the bridge; its errors become ours, with the same text.
template <typename Construct>
auto translated(Construct construct) {
    try {
        return construct();
    } catch (const rust::Error &error) {
        throw Error(error.what());
    }
}

} // namespace

// ---- NormalMap -------------------------------------------------------------------------------------------------------------

struct NormalMap::Impl {
    rust::Box<bridge::Map> map;
};

NormalMap::NormalMap(std::unique_ptr<Impl> impl) : m_impl(std::move(impl)) {}
NormalMap::NormalMap(NormalMap &&) noexcept = default;
NormalMap &NormalMap::operator=(NormalMap &&) noexcept = default;
NormalMap::~NormalMap() = default;

NormalMap NormalMap::load(const std::string &filename, Encoding encoding, bool flip_y) {
    return translated([&] {
        return NormalMap(std::make_unique<Impl>(Impl{bridge::load_map(utf8(filename), to_bridge(encoding), flip_y)}));
    });
}

NormalMap NormalMap::from_normals(const std::string &name, uint32_t width, uint32_t height,
                                  const std::vector<float> &xyz) {
    return translated([&] {
        return NormalMap(
            std::make_unique<Impl>(Impl{bridge::map_from_normals(utf8(name), width, height, slice(xyz))}));
    });
}

uint32_t NormalMap::width() const { return m_impl->map->width(); }
uint32_t NormalMap::height() const { return m_impl->map->height(); }
Vec3 NormalMap::normal(int64_t column, int64_t row) const { return from_bridge(m_impl->map->normal(column, row)); }

// ---- Environment -------------------------------------------------------------------------------------------------------------

struct Environment::Impl {
    rust::Box<bridge::Environment> environment;
};

Environment::Environment(std::unique_ptr<Impl> impl) : m_impl(std::move(impl)) {}
Environment::Environment(Environment &&) noexcept = default;
Environment &Environment::operator=(Environment &&) noexcept = default;
Environment::~Environment() = default;

Environment Environment::fit(const std::vector<float> &directions, const std::vector<float> &weights, uint32_t lobes,
                             float epsilon, uint32_t candidates, uint64_t seed) {
    return translated([&] {
        return Environment(std::make_unique<Impl>(
            Impl{bridge::environment(slice(directions), slice(weights), lobes, epsilon, candidates, seed)}));
    });
}

Environment Environment::fit_map(uint32_t width, uint32_t height, const std::vector<float> &rgb, uint32_t lobes,
                                 float epsilon, uint32_t candidates) {
    return translated([&] {
        return Environment(std::make_unique<Impl>(
            Impl{bridge::environment_of_map(width, height, slice(rgb), lobes, epsilon, candidates)}));
    });
}

Environment Environment::from_file(const std::string &filename, float epsilon, uint32_t candidates) {
    return translated([&] {
        return Environment(
            std::make_unique<Impl>(Impl{bridge::environment_from_file(utf8(filename), epsilon, candidates)}));
    });
}

Environment Environment::turned(const Vec3 &x, const Vec3 &y, const Vec3 &z) const {
    return translated([&] {
        return Environment(
            std::make_unique<Impl>(Impl{m_impl->environment->turned({to_bridge(x), to_bridge(y), to_bridge(z)})}));
    });
}

double Environment::saved_residual() const noexcept { return m_impl->environment->saved_residual(); }

std::string Environment::map_name() const { return std::string(m_impl->environment->map_name()); }

uint32_t Environment::lobe_count() const noexcept { return m_impl->environment->lobe_count(); }

Lobe Environment::lobe(uint32_t index) const noexcept {
    auto lobe = m_impl->environment->lobe(index);
    return {from_bridge(lobe.axis), lobe.sharpness, lobe.weight};
}

float Environment::density(const Vec3 &direction) const noexcept {
    return m_impl->environment->density(to_bridge(direction));
}

std::vector<float> Environment::energies(const std::vector<float> &directions, const std::vector<float> &values,
                                         uint32_t channels) const {
    return translated([&] {
        auto energies = m_impl->environment->energies(slice(directions), slice(values), channels);
        return std::vector<float>(energies.begin(), energies.end());
    });
}

double Environment::residual(const std::vector<float> &directions, const std::vector<float> &weights,
                             const std::vector<float> &radiances) const {
    return translated(
        [&] { return m_impl->environment->residual(slice(directions), slice(weights), slice(radiances)); });
}

// ---- Brdf --------------------------------------------------------------------------------------------------------------------

struct Brdf::Impl {
    rust::Box<bridge::Brdf> brdf;
};

Brdf::Brdf(std::unique_ptr<Impl> impl) : m_impl(std::move(impl)) {}
Brdf::Brdf(Brdf &&) noexcept = default;
Brdf &Brdf::operator=(Brdf &&) noexcept = default;
Brdf::~Brdf() = default;

Brdf Brdf::inverse_bin_map(const NormalMap &map, const SurfaceOptions &surface, const InverseBinMapOptions &options,
                           const InterpolationOptions &interpolation, const FilterOptions &filter) {
    return translated([&] {
        bridge::InverseBinMapOptions given{to_bridge(options.structure), options.bins, options.leaf_size,
                                           to_bridge(options.binning)};
        return Brdf(std::make_unique<Impl>(Impl{bridge::inverse_bin_map(
            *map.m_impl->map, to_bridge(surface), given, to_bridge(interpolation), to_bridge(filter))}));
    });
}

SavedStructure SavedStructure::read(const std::string &structure_file) {
    return translated([&] {
        bridge::SavedStructure s = bridge::saved_structure(utf8(structure_file, "structure_file"));
        return SavedStructure{s.width,
                              s.height,
                              s.refinement,
                              s.refinement_step,
                              s.alpha,
                              from_bridge(s.distribution),
                              s.projected ? Normalization::Projected : Normalization::Paper};
    });
}

Brdf Brdf::load_inverse_bin_map(const std::string &structure_file, const SurfaceOptions &surface, const NormalMap *map,
                                const FilterOptions &filter) {
    return translated([&] {
        rust::Str file = utf8(structure_file, "structure_file");
        bridge::Surface given = to_bridge(surface);
        bridge::FilterOptions seen = to_bridge(filter);
        return Brdf(
            std::make_unique<Impl>(Impl{map ? bridge::load_inverse_bin_map_of(*map->m_impl->map, file, given, seen)
                                            : bridge::load_inverse_bin_map(file, given, seen)}));
    });
}

Brdf Brdf::direct(const NormalMap &map, const SurfaceOptions &surface, const InterpolationOptions &interpolation,
                  const FilterOptions &filter) {
    return translated([&] {
        return Brdf(std::make_unique<Impl>(
            Impl{bridge::direct(*map.m_impl->map, to_bridge(surface), to_bridge(interpolation), to_bridge(filter))}));
    });
}

Brdf Brdf::unfiltered(const NormalMap &map, const SurfaceOptions &surface, Interpolation interpolation) {
    return translated([&] {
        bool bilinear = interpolation == Interpolation::Bilinear;
        return Brdf(std::make_unique<Impl>(Impl{bridge::unfiltered(*map.m_impl->map, to_bridge(surface), bilinear)}));
    });
}

Brdf Brdf::yan16(const NormalMap &map, const SurfaceOptions &surface, const Yan16Options &options) {
    return translated([&] {
        bridge::Yan16Options given{options.curved, options.refinement, options.footprint_sigma};
        return Brdf(std::make_unique<Impl>(Impl{bridge::yan16(*map.m_impl->map, to_bridge(surface), given)}));
    });
}

Brdf Brdf::tensor(const NormalMap &map, const SurfaceOptions &surface, const TensorOptions &options,
                  const std::string &cache) {
    return translated([&] {
        return Brdf(std::make_unique<Impl>(
            Impl{bridge::tensor(*map.m_impl->map, to_bridge(surface), to_bridge(options), utf8(cache))}));
    });
}

std::string Brdf::tensor_cache_file(const NormalMap &map, const SurfaceOptions &surface, const TensorOptions &options,
                                    const std::string &cache) {
    return translated([&] {
        return std::string(
            bridge::tensor_cache_file(*map.m_impl->map, to_bridge(surface), to_bridge(options), utf8(cache)));
    });
}

Brdf Brdf::tensor_from_file(const std::string &filename, const SurfaceOptions &surface) {
    return translated([&] {
        return Brdf(std::make_unique<Impl>(Impl{bridge::tensor_from_file(utf8(filename), to_bridge(surface))}));
    });
}

Evaluation Brdf::evaluate(const Footprint &footprint, const Vec3 &wi, const Vec3 &wo) const noexcept {
    auto e = m_impl->brdf->evaluate(to_bridge(footprint), to_bridge(wi), to_bridge(wo));
    return {e.value, e.pdf};
}

float Brdf::value(const Footprint &footprint, const Vec3 &wi, const Vec3 &wo) const noexcept {
    return evaluate(footprint, wi, wo).value;
}

float Brdf::pdf(const Footprint &footprint, const Vec3 &wi, const Vec3 &wo) const noexcept {
    return m_impl->brdf->pdf(to_bridge(footprint), to_bridge(wi), to_bridge(wo));
}

Sample Brdf::sample(const Footprint &footprint, const Vec3 &wi, float u1, float u2, float u3) const noexcept {
    auto s = m_impl->brdf->sample(to_bridge(footprint), to_bridge(wi), {u1, u2, u3});
    return {from_bridge(s.wo), s.value, s.pdf, s.valid};
}

float Brdf::ndf(const Footprint &footprint, const Vec3 &h) const noexcept {
    return m_impl->brdf->ndf(to_bridge(footprint), to_bridge(h));
}

std::optional<float> Brdf::ndf_over(const Footprint &footprint, float low_x, float low_y, float high_x,
                                    float high_y) const noexcept {
    auto range = m_impl->brdf->ndf_over(to_bridge(footprint), {low_x, low_y}, {high_x, high_y});
    return range.known ? std::optional<float>(range.mean) : std::nullopt;
}

bool Brdf::prefilters() const noexcept { return m_impl->brdf->prefilters(); }

LobeSample Brdf::sample_environment(const Footprint &footprint, const Vec3 &wi, const Vec3 &x, const Vec3 &y,
                                    const Vec3 &z, const Environment &environment, float u1, float u2,
                                    float u3) const noexcept {
    auto s = m_impl->brdf->sample_lobe(to_bridge(footprint), to_bridge(wi), {to_bridge(x), to_bridge(y), to_bridge(z)},
                                       *environment.m_impl->environment, {u1, u2, u3});
    return {s.lobe, s.probability, from_bridge(s.wo), s.value, s.valid};
}

Statistics Brdf::statistics() const { return from_bridge(m_impl->brdf->statistics()); }

// ---- FlakeLayer --------------------------------------------------------------------------------------------------------------

struct FlakeLayer::Impl {
    rust::Box<bridge::FlakeLayer> layer;
};

FlakeLayer::FlakeLayer(std::unique_ptr<Impl> impl) : m_impl(std::move(impl)) {}
FlakeLayer::FlakeLayer(FlakeLayer &&) noexcept = default;
FlakeLayer &FlakeLayer::operator=(FlakeLayer &&) noexcept = default;
FlakeLayer::~FlakeLayer() = default;

FlakeLayer FlakeLayer::inverse_bin_map(const NormalMap &map, const SurfaceOptions &surface,
                                       const FlakeLayerOptions &o) {
    return translated([&] {
        bridge::FlakeLayerOptions options{o.method.bins, o.method.leaf_size, o.gtr_gamma, o.gtr_alpha, o.largest_sine};
        return FlakeLayer(std::make_unique<Impl>(
            Impl{bridge::flake_layer(*map.m_impl->map, utf8(o.mask), to_bridge(surface), options)}));
    });
}

float FlakeLayer::cover(const Footprint &footprint) const noexcept {
    return m_impl->layer->cover(to_bridge(footprint));
}

Evaluation FlakeLayer::evaluate(const Footprint &footprint, const Vec3 &wi, const Vec3 &wo) const noexcept {
    auto e = m_impl->layer->evaluate(to_bridge(footprint), to_bridge(wi), to_bridge(wo));
    return {e.value, e.pdf};
}

FlakeSample FlakeLayer::sample(const Footprint &footprint, const Vec3 &wi, float u1, float u2,
                               float u3) const noexcept {
    auto s = m_impl->layer->sample(to_bridge(footprint), to_bridge(wi), {u1, u2, u3});
    return {from_bridge(s.drawn), from_bridge(s.wo)};
}

Statistics FlakeLayer::statistics() const { return from_bridge(m_impl->layer->statistics()); }

} // namespace glints
