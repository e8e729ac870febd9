// Compile-time proof that this translation unit sees Mitsuba's structures as the wheel does.
//
// Mitsuba's headers choose alignments and vector widths by the instruction set. With other flags everything compiles,
// links and loads, and every colour is garbage. The sizes below were printed by a plugin that renders correctly.
#pragma once

#if !defined(__AVX2__) || !defined(__FMA__) || defined(__AVX512F__)
#  error "Compile with exactly -march=x86-64-v3: Mitsuba's wheel has the structure layout of AVX2 without AVX-512."
#endif
#if defined(__FAST_MATH__)
#  error "Compile without -ffast-math: linking it switches the whole process to flush-to-zero."
#endif
#if __cplusplus != 201703L
#  error "Compile with -std=c++17, as Mitsuba's wheel was."
#endif

#include <mitsuba/mitsuba.h>
#include <mitsuba/render/interaction.h>
#include <string_view>

static_assert(std::string_view(MI_VERSION) == GLINTS_MITSUBA_VERSION,
              "The Mitsuba headers found are of another version than the one mitsuba-glints is written for "
              "(see MITSUBA_VERSION in mitsuba_glints/__init__.py).");

namespace glints_mitsuba {

template <typename Float, typename Spectrum>
constexpr bool has_layout(size_t size, size_t alignment) {
    using Interaction = mitsuba::SurfaceInteraction<Float, Spectrum>;
    return sizeof(Interaction) == size && alignof(Interaction) == alignment;
}

using LlvmFloat = drjit::DiffArray<JitBackend::LLVM, float>;
static_assert(has_layout<float, mitsuba::Color<float, 3>>(240, 16), "SurfaceInteraction3f of scalar_rgb");
static_assert(has_layout<LlvmFloat, mitsuba::Color<LlvmFloat, 3>>(336, 8), "SurfaceInteraction3f of llvm_ad_rgb");

} // namespace glints_mitsuba
