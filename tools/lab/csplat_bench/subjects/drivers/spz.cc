// SPDX-License-Identifier: Apache-2.0
// spz FILE floats|packed: prints "ready", then decodes once for each input line and prints seconds and bytes of arrays.
#include "load-spz.h"

#include <chrono>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <iterator>
#include <unistd.h>

int main(int, char **arguments) {
    std::ifstream file(arguments[1], std::ios::binary);
    const std::vector<uint8_t> data{std::istreambuf_iterator<char>(file), {}};
    const bool packed = std::string(arguments[2]) == "packed";
    FILE *out = fdopen(dup(1), "w");
    if (!freopen("/dev/null", "w", stdout)) return 1; // the library prints there
    std::fprintf(out, "ready\n");
    std::fflush(out);
    for (std::string line; std::getline(std::cin, line);) {
        const auto began = std::chrono::steady_clock::now();
        const auto say = [&](size_t bytes) {
            const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - began;
            std::fprintf(out, "%.9f %zu\n", seconds.count(), bytes);
            std::fflush(out);
        };
        const auto elements = [](const auto &all) {
            return all.positions.size() + all.scales.size() + all.rotations.size() + all.alphas.size() +
                   all.colors.size() + all.sh.size();
        };
        if (packed) {
            const auto all = spz::loadSpzPacked(data);
            say(elements(all));
        } else {
            const auto all = spz::loadSpz(data, {});
            say(elements(all) * sizeof(float));
        }
    }
}
