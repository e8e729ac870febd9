// Filtered BRDFs of normal-mapped microstructure, for any C++ renderer.
//
// Nothing here knows a particular renderer. A host loads a normal map, builds a `Brdf` over it once per
// material, and asks it three questions per shading point: `evaluate`, `pdf` and `sample`. `Brdf` is
// immutable after construction and may be used by any number of threads at the same time.
//
// Conventions
//   directions  unit vectors in the local shading frame; z is the shading normal, x and y run along the
//               texture's u and v. `wi` points to the viewer, `wo` to the light; both point away from the
//               surface. Below the horizon every answer is zero.
//   footprint   in uv units (one period of the map is the unit square), u along the columns and v along
//               the rows of the image, row 0 at v = 0. Outside [0, 1) the map repeats.
//   values      `f(wi, wo) * cos(theta_o)` without Fresnel term and colour: the host multiplies by
//               its own F(dot(wi, h)), with h the half vector.
//
// Errors: construction throws `glints::Error`; its text names the file and the parameter and says what to do.
// Questions never throw and never abort.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#if defined(__GNUC__)
#  define GLINTS_API __attribute__((visibility("default")))
#else
#  define GLINTS_API
#endif

namespace glints {

/// Invalid input: a file that cannot be read, a bad normal, a parameter out of its domain.
class GLINTS_API Error : public std::runtime_error {
public:
    using std::runtime_error::runtime_error;
};

struct Vec3 {
    float x, y, z;
};

/// How a file stores a normal's components c.
enum class Encoding : uint8_t {
    Automatic, ///< `Unsigned` for integer formats, and for floating-point ones without negative components
    Unsigned,  ///< n = 2 c - 1
    Signed,    ///< n = c
};

/// How the texels of a footprint are weighted.
enum class Normalization : uint8_t {
    Projected, ///< by their share of the projected area: the NDF integrates to 1 against the cosine
    Paper,     ///< by their share of the texture's area: the literal Eq. 5 of Atanasov et al. 2021
};

/// Shadowing and masking of the whole map (G_x); the flakes' own Smith term is always present.
enum class Masking : uint8_t {
    None,     ///< G_x = 1
    Beckmann, ///< separable Smith term, roughness from the covariance of the map's slopes
    Explicit, ///< the same with `masking_alpha_u`, `masking_alpha_v`
};

/// The distribution of the microfacets of one flake.
enum class Distribution : uint8_t {
    Beckmann, ///< Gaussian slopes
    Ggx,      ///< a heavy tail: a sixth of the lobe is beyond Beckmann's three standard deviations
};

/// Parameters that every method shares.
struct GLINTS_API SurfaceOptions {
    float alpha = 0.01f; ///< roughness of a flake, in [1e-4, 1]; 0 is a mirror, for `Brdf::inverse_bin_map` only
    Distribution distribution = Distribution::Beckmann;
    Normalization normalization = Normalization::Projected;
    Masking masking = Masking::Beckmann;
    float masking_alpha_u = 0.f, masking_alpha_v = 0.f; ///< only for `Masking::Explicit`; both >= 0
};

/// How the hemisphere of normals is cut into bins.
enum class Binning : uint8_t {
    Automatic,       ///< `EqualSolidAngle` if alpha is 0, else `Projected`
    Projected,       ///< squares on the projected hemisphere, as in Atanasov et al. 2021
    EqualSolidAngle, ///< cells of one solid angle, as in the talk of 2020; only with alpha = 0
};

/// Data structures of the inverse bin map.
enum class Structure : uint8_t {
    Automatic, ///< `Paper` with alpha = 0, `bins`, `leaf_size` or `binning`, which only it has; else `Compact`
    Compact,   ///< this project's: half the memory, lobes where the map has them
    Paper,     ///< that of Atanasov et al. 2021, and with alpha = 0 of their talk of 2020
};

/// Parameters of the inverse bin map; those of the paper's structure may be zero, "derive it as the paper does".
struct GLINTS_API InverseBinMapOptions {
    Structure structure = Structure::Automatic;
    uint32_t bins = 0;      ///< bins per side; 0: floor(5 / sin theta_0), which alpha = 0 does not have
    uint32_t leaf_size = 0; ///< most texels of a leaf of the forest; 0: the paper's 10, with alpha = 0 the talk's 16
    Binning binning = Binning::Automatic;
};

/// What the surface is between the centres of a map's texels.
enum class Interpolation : uint8_t {
    Nearest,  ///< piecewise flat: one normal a texel
    Bilinear, ///< projected normals are interpolated bilinearly
};

/// How the inverse bin map and the direct sum see the surface between the centres of texels. An interpolated map is
/// resampled, the method built from the finer one: memory grows with the square of `refinement`.
struct GLINTS_API InterpolationOptions {
    Interpolation interpolation = Interpolation::Nearest;
    uint32_t refinement = 0; ///< texels per texel and side, 1 to 8; 0: as many as bends and roughness ask for
};

/// How a pixel weights what lies under its footprint.
enum class FootprintFilter : uint8_t {
    Box,      ///< evenly over the parallelogram
    Gaussian, ///< by a Gaussian whose axes are the parallelogram's edges, cut at 3.74 standard deviations
};

/// The filter of the direct sum and of the compact inverse bin map; the paper's answers for the box alone.
struct GLINTS_API FilterOptions {
    FootprintFilter filter = FootprintFilter::Box;
    /// Standard deviation of the Gaussian in pixels (edges of the footprint), in [0.05, 4]: 0.5 is that of Yan et al.'s
    /// published implementation, 1 / sqrt(12) has the variance of the box.
    float footprint_sigma = 0.5f;
};

/// Parameters of Yan et al. 2016; the intrinsic roughness is `SurfaceOptions::alpha / sqrt(2)`.
struct GLINTS_API Yan16Options {
    /// Curved elements follow the bilinearly interpolated map; flat ones have the texels' normals.
    bool curved = false;
    uint32_t refinement = 0;      ///< curved elements per texel and side, 1 to 16; 0: as many as the map needs, 1 or 2
    float footprint_sigma = 0.5f; ///< standard deviation of the Gaussian footprint in pixels, in [0.05, 4]
};

/// Parameters of Deng et al. 2022; numbers of zero are the method's own.
struct GLINTS_API TensorOptions {
    uint32_t rank = 0;       ///< largest rank of a group of blocks, 1 to 64
    float error = 0.f;       ///< relative error of a group at which a smaller rank is taken; 0: always the largest
    uint32_t resolution = 0; ///< pixels per side of an image, a multiple of 16
    uint32_t stride = 0;     ///< texels between the images of the finest level
    bool published = false;  ///< the published solver: one rank, at most 500 iterations
};

/// A pixel's footprint: the parallelogram centred at (u, v), spanned by the two partial derivatives.
struct Footprint {
    float u, v;
    float du_dx = 0.f, dv_dx = 0.f;
    float du_dy = 0.f, dv_dy = 0.f;
};

/// `value` is f * cos(theta_o) without Fresnel and colour, `pdf` the density of `wo` per solid angle.
struct Evaluation {
    float value, pdf;
};

struct Sample {
    Vec3 wo;
    float value, pdf; ///< those of `evaluate(footprint, wi, wo)`
    bool valid;       ///< false: no direction was drawn (masked, below the horizon, or cut off); counts as zero
};

/// A decoded, validated map of unit normals.
class GLINTS_API NormalMap {
public:
    /// Reads an EXR, PNG, JPEG or TIFF file. `flip_y` negates the green component.
    static NormalMap load(const std::string &filename, Encoding encoding = Encoding::Automatic, bool flip_y = false);
    /// Takes `3 * width * height` components, row by row. Normals are normalised; `name` is used in errors.
    static NormalMap from_normals(const std::string &name, uint32_t width, uint32_t height,
                                  const std::vector<float> &xyz);

    uint32_t width() const;
    uint32_t height() const;
    /// The unit normal of a texel; indices wrap around.
    Vec3 normal(int64_t column, int64_t row) const;

    struct Impl;
    NormalMap(NormalMap &&) noexcept;
    NormalMap &operator=(NormalMap &&) noexcept;
    ~NormalMap();

private:
    explicit NormalMap(std::unique_ptr<Impl>);
    std::unique_ptr<Impl> m_impl;
    friend class Brdf;
    friend class FlakeLayer;
};

/// What a structure was made for that `glints precompute ibm` saved.
struct GLINTS_API SavedStructure {
    uint32_t width, height; ///< of the map
    uint32_t refinement;    ///< refined texels per texel and side, if the map was interpolated; 0 if not
    float refinement_step;  ///< their mean step in standard deviations of a lobe; 0 without
    float alpha;
    Distribution distribution;
    Normalization normalization;

    /// Reads the beginning of the file.
    static SavedStructure read(const std::string &structure_file);
};

/// What a method built, for tables and logs.
struct Statistics {
    std::string method;
    uint32_t width, height;                 ///< of the map
    float alpha;                            ///< roughness of a flake; 0: a mirror
    Distribution distribution;              ///< of a flake's microfacets
    uint64_t structure_bytes;               ///< memory that `evaluate`, `pdf` and `sample` need
    double build_seconds;                   ///< wall time of the construction, without reading the map
    uint32_t bins;                          ///< bins per side; 0 for methods without bins
    uint32_t refinement;                    ///< elements or refined texels per texel and side; 0 without
    float refinement_step;                  ///< their mean step in standard deviations of a lobe; 0 without
    float masking_alpha_u, masking_alpha_v; ///< roughness of G_x along u and v; 0 without masking
    std::string warning;                    ///< what users should know about their input; empty: nothing
};

/// A spherical Gaussian exp(sharpness (dot(x, axis) - 1)), normalised to integral one, with its share of the light.
struct Lobe {
    Vec3 axis;
    float sharpness, weight;
};

/// The light of an environment as a mixture of spherical Gaussians, for `Brdf::sample_environment` (Deng et al. 2022,
/// Section 5.4). In any one coordinate system, the host's.
class GLINTS_API Environment {
public:
    /// Fits at most `lobes` lobes to light from the unit vectors `directions`, three numbers each. `weights`: radiance
    /// times the solid angle that a direction stands for. `epsilon`, in (0, 1): a lobe's light counts as coming from
    /// where it is above so many times its peak. `candidates`, 1 to 64: lobes of which a draw keeps one, at a range query
    /// each. Deterministic.
    static Environment fit(const std::vector<float> &directions, const std::vector<float> &weights, uint32_t lobes,
                           float epsilon = 0.3f, uint32_t candidates = 8, uint64_t seed = 0);
    /// Fits to a latitude-longitude picture, `width * height * 3` radiances row by row, what `glints environment` fits
    /// to such a file. In its frame: +y in the first row, +z in the middle, +x a quarter of the width from the left.
    static Environment fit_map(uint32_t width, uint32_t height, const std::vector<float> &rgb, uint32_t lobes,
                               float epsilon = 0.3f, uint32_t candidates = 8);
    /// A fit that `glints environment` saved, in the frame of its map.
    static Environment from_file(const std::string &filename, float epsilon = 0.3f, uint32_t candidates = 8);

    /// The same light in another frame, in which `x`, `y`, `z` are this one's axes: unit vectors at right angles.
    Environment turned(const Vec3 &x, const Vec3 &y, const Vec3 &z) const;

    /// Of a fit from a file: the residual that it had, and the name of its map. One and empty for others.
    double saved_residual() const noexcept;
    std::string map_name() const;

    uint32_t lobe_count() const noexcept;
    Lobe lobe(uint32_t index) const noexcept;
    /// Density of the light, normalised to one, per solid angle.
    float density(const Vec3 &direction) const noexcept;
    /// Splits light of any `channels` (colours, wavelengths) among the lobes, lobe by lobe: `values` has `channels`
    /// numbers for each direction, radiance times solid angle. Sums are kept.
    std::vector<float> energies(const std::vector<float> &directions, const std::vector<float> &values,
                                uint32_t channels) const;
    /// The share of the light that the mixture has elsewhere, in [0, 1]. `weights` are those of the fit, `radiances` the
    /// light per solid angle in the same unit.
    double residual(const std::vector<float> &directions, const std::vector<float> &weights,
                    const std::vector<float> &radiances) const;

    struct Impl;
    Environment(Environment &&) noexcept;
    Environment &operator=(Environment &&) noexcept;
    ~Environment();

private:
    explicit Environment(std::unique_ptr<Impl>);
    std::unique_ptr<Impl> m_impl;
    friend class Brdf;
};

/// A lobe of an environment that a BRDF has drawn. An estimate of the reflected light is the lobe's energy times
/// `value / probability`, Fresnel term, colour and visibility along `wo`.
struct LobeSample {
    uint32_t lobe;
    float probability; ///< of the choice, or what stands for it among several candidates
    Vec3 wo;           ///< a direction from the lobe, in the local frame
    float value;       ///< f * cos(theta_o), averaged over the lobe
    bool valid;        ///< false: nothing was drawn; counts as zero
};

/// A normal map filtered over footprints by one of the methods.
class GLINTS_API Brdf {
public:
    /// Inverse bin map, Atanasov et al. 2021 (Sections 5.2-5.4); with `surface.alpha = 0` that of their talk of 2020,
    /// which needs `options.bins`. The paper's structure refuses a Gaussian `filter`.
    static Brdf inverse_bin_map(const NormalMap &map, const SurfaceOptions &surface,
                                const InverseBinMapOptions &options = {},
                                const InterpolationOptions &interpolation = {}, const FilterOptions &filter = {});
    /// The same from a file of `glints precompute ibm`, which is mapped into memory: it may be replaced or removed later, but
    /// must not be written to or shortened. `surface.alpha`, `distribution` and `normalization` must be those of the file,
    /// see `SavedStructure`. `map` may be null; otherwise it must be the map that the file was made from. Answers are those of
    /// the structure that is built from that map, bit for bit.
    static Brdf load_inverse_bin_map(const std::string &structure_file, const SurfaceOptions &surface,
                                     const NormalMap *map = nullptr, const FilterOptions &filter = {});
    /// The exact sum over every texel of the footprint (Eq. 11).
    static Brdf direct(const NormalMap &map, const SurfaceOptions &surface,
                       const InterpolationOptions &interpolation = {}, const FilterOptions &filter = {});
    /// The normal under the footprint's centre (Eq. 5), whatever the footprint.
    static Brdf unfiltered(const NormalMap &map, const SurfaceOptions &surface,
                           Interpolation interpolation = Interpolation::Nearest);
    /// Position-normal distribution of 4D Gaussians, Yan et al. 2016. `surface.normalization` has to be `Projected`,
    /// and `surface.distribution` `Beckmann`.
    static Brdf yan16(const NormalMap &map, const SurfaceOptions &surface, const Yan16Options &options = {});
    /// Tensor-decomposed distributions, Deng et al. 2022. They are precomputed, which takes minutes for a large map, and
    /// saved to the folder `cache`; the next time they are found there. `surface.normalization` has to be `Projected`.
    static Brdf tensor(const NormalMap &map, const SurfaceOptions &surface, const TensorOptions &options,
                       const std::string &cache);
    /// The file in `cache` that `tensor` loads, or makes if it does not exist.
    static std::string tensor_cache_file(const NormalMap &map, const SurfaceOptions &surface,
                                         const TensorOptions &options, const std::string &cache);
    /// A precomputation that `glints precompute tensor` saved. The roughness and distribution of flakes are the file's.
    static Brdf tensor_from_file(const std::string &filename, const SurfaceOptions &surface);

    Evaluation evaluate(const Footprint &footprint, const Vec3 &wi, const Vec3 &wo) const noexcept;
    /// `evaluate(...).value` alone, and `evaluate(...).pdf` alone.
    float value(const Footprint &footprint, const Vec3 &wi, const Vec3 &wo) const noexcept;
    float pdf(const Footprint &footprint, const Vec3 &wi, const Vec3 &wo) const noexcept;
    /// Draws `wo`. `u1`, `u2`, `u3` are independent and uniform on [0, 1).
    Sample sample(const Footprint &footprint, const Vec3 &wi, float u1, float u2, float u3) const noexcept;
    /// The filtered distribution of normals D_A at the unit half vector `h`, per solid angle.
    float ndf(const Footprint &footprint, const Vec3 &h) const noexcept;
    /// The mean of `ndf` over a rectangle of the projected disk, in x and y of half vectors; outside the disk it counts
    /// as zero. Nothing: the method cannot.
    std::optional<float> ndf_over(const Footprint &footprint, float low_x, float low_y, float high_x,
                                  float high_y) const noexcept;
    /// Does the method answer `ndf_over`, and `sample_environment` with it?
    bool prefilters() const noexcept;
    /// Draws a lobe of the environment's light. `x`, `y`, `z`: the local frame in the environment's coordinates. `u1`
    /// chooses the lobe, `u2`, `u3` a direction from it; independent and uniform on [0, 1).
    LobeSample sample_environment(const Footprint &footprint, const Vec3 &wi, const Vec3 &x, const Vec3 &y,
                                  const Vec3 &z, const Environment &environment, float u1, float u2,
                                  float u3) const noexcept;

    Statistics statistics() const;

    struct Impl;
    Brdf(Brdf &&) noexcept;
    Brdf &operator=(Brdf &&) noexcept;
    ~Brdf();

private:
    explicit Brdf(std::unique_ptr<Impl>);
    std::unique_ptr<Impl> m_impl;
};

/// Parameters of a layer of flakes besides `SurfaceOptions`.
struct GLINTS_API FlakeLayerOptions {
    InverseBinMapOptions method;
    std::string mask;         ///< image of the normal map's size, >= 1/2 where a texel holds a flake; empty: all do
    float gtr_gamma = 0.f;    ///< exponent of a GTR distribution whose Smith term is G_x; 0: that of `SurfaceOptions`
    float gtr_alpha = 0.f;    ///< its roughness
    float largest_sine = 1.f; ///< of the angles between z and all directions asked about; 1 / eta under a coat
};

/// What a draw from a layer of flakes came upon.
enum class Drawn : uint8_t {
    Flake,   ///< a flake, which reflects to `wo`
    Gap,     ///< a texel without flake
    Nothing, ///< a flake that reflects nowhere; counts as zero
};

struct FlakeSample {
    Drawn drawn;
    Vec3 wo; ///< its value and density are those of `evaluate`
};

/// A normal map of flakes with gaps between them, filtered by the inverse bin map.
///
/// Values and densities are those of the flakes alone, in proportion to their share of the footprint: what is below the
/// layer adds its own, times `1 - cover`.
class GLINTS_API FlakeLayer {
public:
    static FlakeLayer inverse_bin_map(const NormalMap &map, const SurfaceOptions &surface,
                                      const FlakeLayerOptions &options = {});

    /// The share of the footprint that flakes cover.
    float cover(const Footprint &footprint) const noexcept;
    Evaluation evaluate(const Footprint &footprint, const Vec3 &wi, const Vec3 &wo) const noexcept;
    /// Draws a texel of the footprint and what is there. `u1`, `u2`, `u3` are independent and uniform on [0, 1).
    FlakeSample sample(const Footprint &footprint, const Vec3 &wi, float u1, float u2, float u3) const noexcept;

    /// With the mip map of the mask in `structure_bytes`.
    Statistics statistics() const;

    struct Impl;
    FlakeLayer(FlakeLayer &&) noexcept;
    FlakeLayer &operator=(FlakeLayer &&) noexcept;
    ~FlakeLayer();

private:
    explicit FlakeLayer(std::unique_ptr<Impl>);
    std::unique_ptr<Impl> m_impl;
};

} // namespace glints
