// SPDX-License-Identifier: Apache-2.0
// spz_encode SCENE.ply FILE.spz: encodes once, prints wall and CPU seconds from floats to bytes.
#include "load-spz.h"

#include <chrono>
#include <cstdio>
#include <ctime>
#include <fstream>
#include <unistd.h>

int main(int, char **arguments) {
    FILE *out = fdopen(dup(1), "w");
    if (!freopen("/dev/null", "w", stdout)) return 1; // the library prints there
    const auto scene = spz::loadSplatFromPly(arguments[1], {});
    std::vector<uint8_t> data;
    const auto began = std::chrono::steady_clock::now();
    const auto began_cpu = std::clock(); // of all threads
    if (!spz::saveSpz(scene, {}, &data)) return 1;
    const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - began;
    std::fprintf(out, "%.6f %.6f\n", seconds.count(), double(std::clock() - began_cpu) / CLOCKS_PER_SEC);
    std::ofstream(arguments[2], std::ios::binary).write(reinterpret_cast<const char *>(data.data()), data.size());
    return std::fclose(out);
}
