// Errors of memory on purpose: the broken twins of scripts/memcheck, which must report each of them.
//
//     planted MAP none|uninitialised|leak
//
// `uninitialised` asks with a footprint that was never written, so that code of libglints.so branches on it; `leak` forgets
// what libglints.so allocated; `none` does neither, and must pass.

#include <glints/glints.h>

#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <new>

int main(int argc, char **argv) {
    if (argc != 3)
        return 2;
    const char *error = argv[2];
    glints::NormalMap map = glints::NormalMap::load(argv[1]);
    void *place = std::malloc(sizeof(glints::Brdf));
    auto *brdf = new (place) glints::Brdf(glints::Brdf::inverse_bin_map(map, {}));

    auto *footprint = static_cast<glints::Footprint *>(std::malloc(sizeof(glints::Footprint)));
    if (std::strcmp(error, "uninitialised") != 0)
        *footprint = {0.5f, 0.5f, 0.1f, 0.f, 0.f, 0.1f};
    glints::Evaluation e = brdf->evaluate(*footprint, {0.f, 0.f, 1.f}, {0.f, 0.f, 1.f});
    std::printf("%s\n", e.value >= 0.f ? "done" : "negative");
    std::free(footprint);

    if (std::strcmp(error, "leak") != 0)
        brdf->~Brdf();
    std::free(place);
    return 0;
}
