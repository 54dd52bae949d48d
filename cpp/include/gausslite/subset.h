// Decode the subset message of docs/reference/wire.md: voxel updates of an agent or of a fused map.
//
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace gausslite {

/// A message that is damaged, too large, or of another version.
class DecodeError : public std::runtime_error {
public:
    using std::runtime_error::runtime_error;
};

struct Gaussian {
    std::array<float, 3> mean_m;
    std::array<float, 4> quat_wxyz;
    std::array<float, 3> scales_m;
    float opacity;
    std::array<float, 3> rgb;
    bool active;
    std::uint32_t kappa;
    std::int16_t target;  // index into the task's targets, -1 for none
};

/// The complete content of one voxel; without Gaussians it is a tombstone.
struct Voxel {
    std::int64_t key;
    std::uint64_t kappa_sum;
    std::vector<Gaussian> gaussians;
};

struct Subset {
    std::string agent_id;
    std::string session_id;
    std::uint64_t message_seq;
    std::uint64_t update_seq;
    double voxel_size_m;
    std::vector<Voxel> voxels;  // by ascending key
};

/// Upper limits of a message; they are checked before memory is allocated.
struct Limits {
    std::size_t max_bytes = std::size_t{1} << 20;
    std::uint32_t max_voxels = 200'000;
    std::uint32_t max_gaussians = 200'000;
};

/// Decode one message. Throws DecodeError.
Subset decode_subset(std::string_view message, const Limits& limits = {});

}  // namespace gausslite
