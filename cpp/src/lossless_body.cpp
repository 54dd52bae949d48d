// Decode the lossless coding: every value as a float (docs/reference/wire.md, "Lossless").
//
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>

#include "columns.h"

namespace gausslite {
namespace {

constexpr float max_value = 1e6F, min_largest_component = 1e-6F;

/// Throw DecodeError for values that a receiver could not render, and for a mean outside its voxel.
void require_usable(const Gaussian& gaussian, const std::array<std::int64_t, 3>& voxel, double size_m) {
    float largest = 0.0F;
    for (const auto value : gaussian.quat_wxyz) {
        largest = std::max(largest, std::abs(value));
        if (!(std::abs(value) <= max_value)) {
            throw DecodeError("subset quats: expected finite values");
        }
    }
    for (std::size_t axis = 0; axis < 3; ++axis) {
        const auto scale = gaussian.scales_m[axis];
        if (!(scale > 0.0F && scale <= max_value) || !(std::abs(gaussian.rgb[axis]) <= max_value)) {
            throw DecodeError("subset: expected positive scales and finite colours");
        }
        if (std::floor(static_cast<double>(gaussian.mean_m[axis]) / size_m) != static_cast<double>(voxel[axis])) {
            throw DecodeError("subset means: expected every mean inside its voxel");
        }
    }
    if (largest < min_largest_component || !(gaussian.opacity >= 0.0F && gaussian.opacity <= 1.0F)) {
        throw DecodeError("subset: expected rotations, and opacities of 0 to 1");
    }
}

}  // namespace

std::vector<Gaussian> decode_lossless(std::string_view body, const Header& header, VoxelColumns& voxels) {
    const std::size_t n = header.gaussians;
    ColumnReader reader(body, shared_bytes(header) + n * 4 * (3 + 4 + 3 + 1 + 3));
    voxels = read_voxels(reader, header);
    const auto means = reader.floats(3 * n), quats = reader.floats(4 * n), scales = reader.floats(3 * n),
               opacities = reader.floats(n), rgb = reader.floats(3 * n);
    std::vector<Gaussian> gaussians(n);
    read_labels(reader, header, gaussians);
    std::size_t row = 0;
    for (std::size_t v = 0; v < voxels.keys.size(); ++v) {
        const auto voxel = voxel_of(voxels.keys[v]);
        for (std::size_t i = 0; i < voxels.counts[v]; ++i, ++row) {
            auto& gaussian = gaussians[row];
            for (std::size_t axis = 0; axis < 3; ++axis) {
                gaussian.mean_m[axis] = means[3 * row + axis];
                gaussian.scales_m[axis] = scales[3 * row + axis];
                gaussian.rgb[axis] = rgb[3 * row + axis];
            }
            for (std::size_t component = 0; component < 4; ++component) {
                gaussian.quat_wxyz[component] = quats[4 * row + component];
            }
            gaussian.opacity = opacities[row];
            require_usable(gaussian, voxel, header.voxel_size_m);
        }
    }
    return gaussians;
}

}  // namespace gausslite
