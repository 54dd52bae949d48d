// The compressed columns of a message's body, and what surrounds them (docs/reference/wire.md).
//
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <cstring>
#include <string_view>
#include <vector>

#include "gausslite/subset.h"

namespace gausslite {

struct Header {
    bool lossless;
    unsigned kappa_bytes, target_bytes, coarse_bits;
    int scale_code;
    std::size_t voxels, gaussians;
    double voxel_size_m;
};

/// Voxel indices (i, j, k) of a key.
std::array<std::int64_t, 3> voxel_of(std::int64_t key);

/// Reads the columns of a decompressed frame in order.
class ColumnReader {
public:
    /// Decompress a frame that must have exactly this content size. Throws DecodeError.
    ColumnReader(std::string_view frame, std::size_t content_bytes);

    std::vector<std::uint64_t> unsigned_numbers(std::size_t count, unsigned bytes);
    std::vector<float> floats(std::size_t count);
    std::vector<std::uint8_t> bytes(std::size_t count);

private:
    std::vector<std::uint8_t> content_;
    std::size_t place_ = 0;
};

/// Columns of both codings.
struct VoxelColumns {
    std::vector<std::int64_t> keys;
    std::vector<std::uint64_t> extra_kappa;
    std::vector<std::size_t> counts;
};

VoxelColumns read_voxels(ColumnReader& reader, const Header& header);
void read_labels(ColumnReader& reader, const Header& header, std::vector<Gaussian>& gaussians);
std::size_t shared_bytes(const Header& header);

/// The Gaussians of a body, voxel after voxel. Throws DecodeError.
std::vector<Gaussian> decode_quantised(std::string_view body, const Header& header, VoxelColumns& voxels);
std::vector<Gaussian> decode_lossless(std::string_view body, const Header& header, VoxelColumns& voxels);

}  // namespace gausslite
