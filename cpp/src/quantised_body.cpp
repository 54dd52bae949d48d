// Decode the quantised coding: one byte a value, and positions as bit fields (docs/reference/wire.md, "Quantised").
//
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <limits>

#include "columns.h"

namespace gausslite {
namespace {

constexpr unsigned max_fine_bits = 15;
constexpr double scale_steps = 7.0, scale_min_exponent = -20.0;
constexpr std::size_t symbol_bytes = 12;

/// Reads unsigned numbers of different widths, lowest bit first.
class BitReader {
public:
    explicit BitReader(std::string_view data) : data_(data) {}

    std::uint32_t read(unsigned width) {
        std::uint32_t value = 0;
        for (unsigned bit = 0; bit < width; ++bit, ++place_) {
            if (place_ / 8 >= data_.size()) {
                throw DecodeError("subset: the bit fields are too short");
            }
            value |= static_cast<std::uint32_t>(static_cast<unsigned char>(data_[place_ / 8]) >> (place_ % 8) & 1)
                     << bit;
        }
        return value;
    }

    void require_end() {
        if ((place_ + 7) / 8 != data_.size()) {
            throw DecodeError("subset: the bit fields have another size");
        }
        while (place_ % 8 != 0) {
            if (read(1) != 0) {
                throw DecodeError("subset: expected zeros after the last bit field");
            }
        }
    }

private:
    std::string_view data_;
    std::size_t place_ = 0;
};

/// Scale codes and what follows from them.
struct Shape {
    std::array<std::uint8_t, 3> codes;
    unsigned bits;  // per axis of the position
    int quat_steps;
};

Shape shape_of(std::uint8_t first, std::uint8_t second, std::uint8_t third, const Header& header) {
    Shape shape{};
    shape.codes = {first, static_cast<std::uint8_t>(first + second), static_cast<std::uint8_t>(first + third)};
    const auto [low, high] = std::minmax_element(shape.codes.begin(), shape.codes.end());
    const int octaves = static_cast<int>(std::ceil((header.scale_code - *low) / scale_steps));
    shape.bits = static_cast<unsigned>(
        std::clamp(octaves, static_cast<int>(header.coarse_bits), static_cast<int>(max_fine_bits)));
    const double ratio = std::pow(2.0, (*high - *low) / scale_steps);
    shape.quat_steps = std::min(127, static_cast<int>(std::ceil(4.0 * (ratio - 1.0 / ratio))));
    return shape;
}

std::array<float, 4> quat_of(unsigned largest, std::array<std::uint8_t, 3> others, int steps) {
    if (largest > 3) {
        throw DecodeError("subset quats: expected an index of 0 to 3");
    }
    std::array<double, 4> full{};
    full[largest] = std::max(steps, 1);
    double squares = full[largest] * full[largest];
    for (std::size_t component = 0, other = 0; component < 4; ++component) {
        if (component == largest) {
            continue;
        }
        const int offset = others[other++] - 128;
        if (std::abs(offset) > steps) {
            throw DecodeError("subset quats: expected components up to the largest");
        }
        full[component] = offset;
        squares += full[component] * full[component];
    }
    const double norm = std::sqrt(squares);
    std::array<float, 4> quat{};
    std::transform(full.begin(), full.end(), quat.begin(),
                   [norm](double value) { return static_cast<float>(value / norm); });
    return quat;
}

std::array<float, 3> rgb_of(unsigned luma_code, unsigned orange_code, unsigned lime_code) {
    if (std::max({luma_code, orange_code, lime_code}) > 128) {
        throw DecodeError("subset rgb: expected codes up to 128");
    }
    const double luma = -0.5 + luma_code / 64.0, orange = -2.0 + orange_code / 32.0, lime = -2.0 + lime_code / 32.0;
    const double middle = luma - lime / 2, blue = middle - orange / 2;
    return {static_cast<float>(blue + orange), static_cast<float>(middle + lime), static_cast<float>(blue)};
}

/// The point of the voxel nearest to the centre of the cell, on one axis.
float centre_of(std::uint32_t cell, unsigned bits, std::int64_t voxel, double size_m) {
    const double count = static_cast<double>(std::uint64_t{1} << bits);
    const double index = static_cast<double>(voxel);
    auto mean_m = static_cast<float>(index * size_m + (cell + 0.5) * (size_m / count));
    // rounding to float can cross a voxel's face by one float
    const double rounded = std::floor(static_cast<double>(mean_m) / size_m);
    if (rounded < index) {
        mean_m = std::nextafter(mean_m, std::numeric_limits<float>::infinity());
    }
    if (rounded > index) {
        mean_m = std::nextafter(mean_m, -std::numeric_limits<float>::infinity());
    }
    return mean_m;
}

/// The cells of all Gaussians, from the lengths of the Morton codes' differences and the bit fields.
std::vector<std::array<std::uint32_t, 3>> read_cells(const std::vector<std::uint8_t>& lengths,
                                                     const std::vector<Shape>& shapes, const VoxelColumns& voxels,
                                                     unsigned coarse_bits, std::string_view fields) {
    BitReader reader(fields);
    std::vector<std::uint64_t> codes(lengths.size());
    for (std::size_t i = 0; i < lengths.size(); ++i) {
        if (lengths[i] > 3 * coarse_bits) {
            throw DecodeError("subset positions: a difference is too long");
        }
        // the highest bit of a difference is always one, so it is not stored
        codes[i] = lengths[i] == 0 ? 0 : reader.read(lengths[i] - 1u) | std::uint32_t{1} << (lengths[i] - 1u);
    }
    std::size_t row = 0;
    for (const auto count : voxels.counts) {
        for (std::size_t i = 0; i < count; ++i, ++row) {
            codes[row] += i == 0 ? 0 : codes[row - 1];
            if (codes[row] >> (3 * coarse_bits) != 0) {
                throw DecodeError("subset positions: expected cells inside their voxels");
            }
        }
    }
    std::vector<std::array<std::uint32_t, 3>> cells(lengths.size());
    for (std::size_t axis = 0; axis < 3; ++axis) {
        for (std::size_t i = 0; i < cells.size(); ++i) {
            const unsigned fine = shapes[i].bits - coarse_bits;
            cells[i][axis] = reader.read(fine);
            for (unsigned place = 0; place < coarse_bits; ++place) {
                cells[i][axis] |= static_cast<std::uint32_t>(codes[i] >> (3 * place + 2 - axis) & 1) << (place + fine);
            }
        }
    }
    reader.require_end();
    return cells;
}

}  // namespace

std::vector<Gaussian> decode_quantised(std::string_view body, const Header& header, VoxelColumns& voxels) {
    const std::size_t n = header.gaussians;
    if (body.size() < 4) {
        throw DecodeError("subset: the body is too short");
    }
    std::uint32_t frame_bytes = 0;
    for (unsigned i = 0; i < 4; ++i) {
        frame_bytes |= static_cast<std::uint32_t>(static_cast<unsigned char>(body[i])) << (8 * i);
    }
    if (frame_bytes > body.size() - 4) {
        throw DecodeError("subset: the frame is longer than the body");
    }
    ColumnReader reader(body.substr(4, frame_bytes), shared_bytes(header) + symbol_bytes * n);
    voxels = read_voxels(reader, header);
    std::array<std::vector<std::uint8_t>, symbol_bytes> symbols;
    for (auto& column : symbols) {
        column = reader.bytes(n);
    }
    std::vector<Gaussian> gaussians(n);
    read_labels(reader, header, gaussians);
    std::vector<Shape> shapes(n);
    std::uint8_t first = 0;
    for (std::size_t i = 0; i < n; ++i) {
        first = static_cast<std::uint8_t>(first + symbols[1][i]);
        shapes[i] = shape_of(first, symbols[2][i], symbols[3][i], header);
    }
    const auto cells = read_cells(symbols[0], shapes, voxels, header.coarse_bits, body.substr(4 + frame_bytes));
    std::array<std::uint8_t, 3> colour{};
    std::size_t row = 0;
    for (std::size_t v = 0; v < voxels.keys.size(); ++v) {
        const auto voxel = voxel_of(voxels.keys[v]);
        for (std::size_t i = 0; i < voxels.counts[v]; ++i, ++row) {
            auto& gaussian = gaussians[row];
            for (std::size_t axis = 0; axis < 3; ++axis) {
                gaussian.mean_m[axis] =
                    centre_of(cells[row][axis], shapes[row].bits, voxel[axis], header.voxel_size_m);
                gaussian.scales_m[axis] =
                    static_cast<float>(std::exp2(scale_min_exponent + shapes[row].codes[axis] / scale_steps));
                colour[axis] = static_cast<std::uint8_t>(colour[axis] + symbols[9 + axis][row]);
            }
            gaussian.quat_wxyz = quat_of(symbols[4][row], {symbols[5][row], symbols[6][row], symbols[7][row]},
                                         shapes[row].quat_steps);
            if (symbols[8][row] >= 64) {
                throw DecodeError("subset opacities: expected codes below 64");
            }
            gaussian.opacity = static_cast<float>((symbols[8][row] + 0.5) / 64.0);
            gaussian.rgb = rgb_of(colour[0], colour[1], colour[2]);
        }
    }
    return gaussians;
}

}  // namespace gausslite
