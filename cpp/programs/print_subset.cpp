// gausslite_print_subset FILE: print a message as text, a line for each voxel and Gaussian. Exit code 2 if it is damaged.
//
// SPDX-License-Identifier: Apache-2.0
#include <cinttypes>
#include <cstdio>
#include <exception>
#include <fstream>
#include <iterator>

#include "gausslite/subset.h"

int main(int count, char** arguments) try {
    if (count != 2) {
        std::fprintf(stderr, "usage: gausslite_print_subset FILE\n");
        return 2;
    }
    std::ifstream file(arguments[1], std::ios::binary);
    if (!file) {
        std::fprintf(stderr, "%s: expected a readable file\n", arguments[1]);
        return 2;
    }
    const std::string message{std::istreambuf_iterator<char>(file), {}};
    const auto subset = gausslite::decode_subset(message);
    std::printf("subset %s %s %" PRIu64 " %" PRIu64 " %.17g\n", subset.agent_id.c_str(), subset.session_id.c_str(),
                subset.message_seq, subset.update_seq, subset.voxel_size_m);
    for (const auto& voxel : subset.voxels) {
        std::printf("voxel %" PRId64 " %" PRIu64 " %zu\n", voxel.key, voxel.kappa_sum, voxel.gaussians.size());
        for (const auto& g : voxel.gaussians) {
            // nine digits state a float exactly
            std::printf("gaussian %.9g %.9g %.9g", static_cast<double>(g.mean_m[0]), static_cast<double>(g.mean_m[1]),
                        static_cast<double>(g.mean_m[2]));
            for (const auto value : g.quat_wxyz) std::printf(" %.9g", static_cast<double>(value));
            for (const auto value : g.scales_m) std::printf(" %.9g", static_cast<double>(value));
            std::printf(" %.9g", static_cast<double>(g.opacity));
            for (const auto value : g.rgb) std::printf(" %.9g", static_cast<double>(value));
            std::printf(" %d %" PRIu32 " %d\n", g.active ? 1 : 0, g.kappa, g.target);
        }
    }
    return 0;
} catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 2;
}
