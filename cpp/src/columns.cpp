// Read the columns that both codings share: voxels, kappa, targets and active flags.
//
// SPDX-License-Identifier: Apache-2.0
#include "columns.h"

#include <zstd.h>

#include <memory>
#include <string>

namespace gausslite {
namespace {

constexpr unsigned axis_bits = 21;
constexpr std::int64_t axis_mask = (std::int64_t{1} << axis_bits) - 1;
constexpr std::int64_t axis_offset = std::int64_t{1} << (axis_bits - 1);

void require_frame(std::string_view frame, std::size_t content_bytes) {
    const auto declared = ZSTD_getFrameContentSize(frame.data(), frame.size());
    if (declared == ZSTD_CONTENTSIZE_ERROR || declared == ZSTD_CONTENTSIZE_UNKNOWN || declared != content_bytes) {
        throw DecodeError("subset: expected a zstd frame of " + std::to_string(content_bytes) + " bytes");
    }
    if (ZSTD_findFrameCompressedSize(frame.data(), frame.size()) != frame.size()) {
        throw DecodeError("subset: expected one zstd frame, got other bytes");
    }
}

}  // namespace

std::array<std::int64_t, 3> voxel_of(std::int64_t key) {
    return {((key >> (2 * axis_bits)) & axis_mask) - axis_offset, ((key >> axis_bits) & axis_mask) - axis_offset,
            (key & axis_mask) - axis_offset};
}

ColumnReader::ColumnReader(std::string_view frame, std::size_t content_bytes) {
    require_frame(frame, content_bytes);
    content_.resize(content_bytes);
    const std::unique_ptr<ZSTD_DCtx, decltype(&ZSTD_freeDCtx)> context(ZSTD_createDCtx(), &ZSTD_freeDCtx);
    const auto got = ZSTD_decompressDCtx(context.get(), content_.data(), content_.size(), frame.data(), frame.size());
    if (ZSTD_isError(got) || got != content_bytes) {
        throw DecodeError("subset: the zstd frame is damaged");
    }
}

std::vector<std::uint64_t> ColumnReader::unsigned_numbers(std::size_t count, unsigned bytes) {
    std::vector<std::uint64_t> numbers(count, 0);
    for (unsigned byte = 0; byte < bytes; ++byte) {
        for (auto& number : numbers) {
            number |= std::uint64_t{content_.at(place_++)} << (8 * byte);
        }
    }
    return numbers;
}

std::vector<float> ColumnReader::floats(std::size_t count) {
    const auto bits = unsigned_numbers(count, 4);
    std::vector<float> values(count);
    for (std::size_t i = 0; i < count; ++i) {
        const auto narrow = static_cast<std::uint32_t>(bits[i]);
        std::memcpy(&values[i], &narrow, sizeof narrow);
    }
    return values;
}

std::vector<std::uint8_t> ColumnReader::bytes(std::size_t count) {
    if (count > content_.size() - place_) {
        throw DecodeError("subset: a column is too short");
    }
    const auto first = content_.begin() + static_cast<std::ptrdiff_t>(place_);
    place_ += count;
    return {first, first + static_cast<std::ptrdiff_t>(count)};
}

std::size_t shared_bytes(const Header& header) {
    return header.voxels * (8 + 8 + 4) + header.gaussians * (header.kappa_bytes + header.target_bytes) +
           (header.gaussians + 7) / 8;
}

VoxelColumns read_voxels(ColumnReader& reader, const Header& header) {
    VoxelColumns voxels;
    std::uint64_t key = 0;
    for (const auto difference : reader.unsigned_numbers(header.voxels, 8)) {
        key += difference;
        if (key > static_cast<std::uint64_t>(INT64_MAX)) {
            throw DecodeError("subset: expected voxel keys of at least 0, got a negative one");
        }
        if (!voxels.keys.empty() && difference == 0) {
            throw DecodeError("subset: expected ascending voxel keys");
        }
        if (!voxels.keys.empty() && static_cast<std::int64_t>(key) < voxels.keys.back()) {
            throw DecodeError("subset: expected ascending voxel keys");
        }
        voxels.keys.push_back(static_cast<std::int64_t>(key));
    }
    voxels.extra_kappa = reader.unsigned_numbers(header.voxels, 8);
    std::uint64_t total = 0;
    for (const auto count : reader.unsigned_numbers(header.voxels, 4)) {
        voxels.counts.push_back(count);
        total += count;
    }
    if (total != header.gaussians) {
        throw DecodeError("subset: voxel counts sum to " + std::to_string(total) + ", expected " +
                          std::to_string(header.gaussians));
    }
    return voxels;
}

void read_labels(ColumnReader& reader, const Header& header, std::vector<Gaussian>& gaussians) {
    const auto differences = reader.unsigned_numbers(header.gaussians, header.kappa_bytes);
    const auto targets = reader.unsigned_numbers(header.gaussians, header.target_bytes);
    const auto flags = reader.bytes((header.gaussians + 7) / 8);
    const std::uint64_t kappa_mask = (std::uint64_t{1} << (8 * header.kappa_bytes)) - 1;
    std::uint64_t kappa = 0;
    for (std::size_t i = 0; i < gaussians.size(); ++i) {
        kappa = (kappa + differences[i]) & kappa_mask;
        gaussians[i].kappa = static_cast<std::uint32_t>(kappa);
        gaussians[i].target = header.target_bytes == 1 ? static_cast<std::int8_t>(targets[i])
                                                       : static_cast<std::int16_t>(targets[i]);
        gaussians[i].active = (flags[i / 8] >> (i % 8) & 1) != 0;
    }
}

}  // namespace gausslite
