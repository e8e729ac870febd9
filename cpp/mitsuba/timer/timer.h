// Nanoseconds per call of a BSDF's methods, measured in a C++ loop inside Mitsuba's process (variant scalar_rgb).
//
// For benchmarks from Python, by ctypes. The BSDF is any that Mitsuba has built, of this package or a stock one; it is
// handed over by its address, `bsdf.ptr`, and must stay alive during the call:
//
//     class Settings(ctypes.Structure):
//         _fields_ = [("footprint_width_u", ctypes.c_float), ("footprint_width_v", ctypes.c_float),
//                     ("max_angle_wi", ctypes.c_float), ("sampled_wo", ctypes.c_float),
//                     ("interactions", ctypes.c_uint32), ("repetitions", ctypes.c_uint32), ("seed", ctypes.c_uint32)]
//
//     class Timings(ctypes.Structure):
//         _fields_ = [(name, ctypes.c_double) for name in
//                     ("eval_ns", "pdf_ns", "sample_ns", "eval_pdf_ns", "overhead_ns", "valid_samples", "checksum")]
//
//     mi.set_variant("scalar_rgb")
//     timer = ctypes.CDLL(os.path.join(mitsuba_glints.plugin_dir(), "plugins", "libglints_timer.so"))
//     timer.glints_time_bsdf.argtypes = [ctypes.c_void_p, ctypes.POINTER(Settings), ctypes.POINTER(Timings)]
//     timer.glints_time_bsdf.restype = ctypes.c_char_p           # None, or the reason of a failure
//     bsdf = mi.load_dict({"type": "roughconductor"})
//     error = timer.glints_time_bsdf(bsdf.ptr, settings, timings)
#pragma once

#include <cstdint>

extern "C" {

struct GlintsTimerSettings {
    /// Square footprint, in uv: duv_dx = (width_u, 0), duv_dy = (0, width_v). For w texels: w / resolution.
    float footprint_width_u, footprint_width_v;
    /// wi is uniform in the cone of this half angle (radians) around the normal.
    float max_angle_wi;
    /// Share of the outgoing directions drawn from the BSDF, so that its lobes are hit, as in the second strategy of
    /// multiple importance sampling; the rest is uniform over the hemisphere, as towards an environment light.
    float sampled_wo;
    /// Shading points, at uniform random uv in the unit square. Many: cold caches, as in a render.
    uint32_t interactions;
    /// Passes over all of them. The fastest pass counts.
    uint32_t repetitions;
    uint32_t seed;
};

struct GlintsTimerTimings {
    double eval_ns, pdf_ns, sample_ns, eval_pdf_ns; ///< per call, `overhead_ns` included
    double overhead_ns;                             ///< per iteration of the empty loop
    double valid_samples;                           ///< share of `sample` calls that gave a direction
    double checksum;                                ///< of all results: proof that nothing was optimised away
};

/// Null on success, or a message that stays valid until the thread's next call.
__attribute__((visibility("default"))) const char *glints_time_bsdf(void *bsdf, const GlintsTimerSettings *settings,
                                                                    GlintsTimerTimings *timings);
}
