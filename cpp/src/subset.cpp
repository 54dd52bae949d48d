// Decode a message's header, check its CRC32C and limits, and assemble the voxels.
//
// SPDX-License-Identifier: Apache-2.0
#include "gausslite/subset.h"

#include <cmath>

#include "columns.h"

namespace gausslite {
namespace {

constexpr std::size_t header_bytes = 49, trailer_bytes = 4;
constexpr unsigned version = 2, max_coarse_bits = 5;

template <typename T>
T read_number(std::string_view data, std::size_t offset) {
    std::uint64_t bits = 0;
    for (std::size_t i = 0; i < sizeof(T); ++i) {
        bits |= std::uint64_t{static_cast<unsigned char>(data.at(offset + i))} << (8 * i);
    }
    T value;
    // the lowest bytes first on every machine
    if constexpr (sizeof(T) == sizeof(bits)) {
        std::memcpy(&value, &bits, sizeof value);
    } else {
        value = static_cast<T>(bits);
    }
    return value;
}

std::uint32_t crc32c(std::string_view data) {
    constexpr std::uint32_t polynomial = 0x82F63B78;
    std::uint32_t crc = ~std::uint32_t{0};
    for (const char each : data) {
        crc ^= static_cast<unsigned char>(each);
        for (int bit = 0; bit < 8; ++bit) {
            crc = (crc >> 1) ^ (polynomial & (~(crc & 1) + 1));
        }
    }
    return ~crc;
}

Header read_header(std::string_view message, const Limits& limits) {
    if (message.size() > limits.max_bytes || message.size() < header_bytes + trailer_bytes) {
        throw DecodeError("subset: expected " + std::to_string(header_bytes + trailer_bytes) + " to " +
                          std::to_string(limits.max_bytes) + " bytes, got " + std::to_string(message.size()));
    }
    if (message.substr(0, 4) != "GLSB" || read_number<std::uint16_t>(message, 4) != version) {
        throw DecodeError("subset: expected version 2 of the codec, got other bytes");
    }
    if (crc32c(message.substr(0, message.size() - trailer_bytes)) !=
        read_number<std::uint32_t>(message, message.size() - trailer_bytes)) {
        throw DecodeError("subset: CRC32C does not match; the message was damaged");
    }
    const auto coding = read_number<std::uint8_t>(message, 6);
    Header header{coding == 1,
                  read_number<std::uint8_t>(message, 7),
                  read_number<std::uint8_t>(message, 8),
                  read_number<std::uint8_t>(message, 9),
                  read_number<std::uint8_t>(message, 10),
                  read_number<std::uint32_t>(message, 11),
                  read_number<std::uint32_t>(message, 15),
                  read_number<double>(message, 23)};
    const auto kappa = header.kappa_bytes, target = header.target_bytes;
    if (coding > 1 || (kappa != 1 && kappa != 2 && kappa != 4) || (target != 1 && target != 2) ||
        header.coarse_bits > max_coarse_bits) {
        throw DecodeError("subset: expected a known coding and column widths, got others");
    }
    if (header.voxels > limits.max_voxels || header.gaussians > limits.max_gaussians) {
        throw DecodeError("subset: more voxels or Gaussians than the limit");
    }
    if (!(header.voxel_size_m >= 1e-3 && header.voxel_size_m <= 1e3)) {
        throw DecodeError("subset: expected a voxel size of 0.001 to 1000 m");
    }
    return header;
}

}  // namespace

Subset decode_subset(std::string_view message, const Limits& limits) {
    const auto header = read_header(message, limits);
    const std::size_t body_bytes = read_number<std::uint32_t>(message, 19);
    const std::size_t agent_bytes = read_number<std::uint8_t>(message, 47);
    const std::size_t session_bytes = read_number<std::uint8_t>(message, 48);
    const std::size_t body_start = header_bytes + agent_bytes + session_bytes;
    if (body_start + body_bytes + trailer_bytes != message.size()) {
        throw DecodeError("subset: the message has another size than it declares");
    }
    Subset subset{std::string(message.substr(header_bytes, agent_bytes)),
                  std::string(message.substr(header_bytes + agent_bytes, session_bytes)),
                  read_number<std::uint64_t>(message, 31),
                  read_number<std::uint64_t>(message, 39),
                  header.voxel_size_m,
                  {}};
    VoxelColumns voxels;
    const auto body = message.substr(body_start, body_bytes);
    const auto gaussians =
        header.lossless ? decode_lossless(body, header, voxels) : decode_quantised(body, header, voxels);
    subset.voxels.reserve(voxels.keys.size());
    auto next = gaussians.begin();
    for (std::size_t v = 0; v < voxels.keys.size(); ++v) {
        const auto end = next + static_cast<std::ptrdiff_t>(voxels.counts[v]);
        Voxel voxel{voxels.keys[v], voxels.extra_kappa[v], {next, end}};
        for (const auto& gaussian : voxel.gaussians) {
            voxel.kappa_sum += gaussian.kappa;
        }
        subset.voxels.push_back(std::move(voxel));
        next = end;
    }
    return subset;
}

}  // namespace gausslite
