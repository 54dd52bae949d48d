// SPDX-License-Identifier: Apache-2.0
// The extension module gausslite.codec._unpack: the body of a quantised message becomes the elements that a store keeps.
// docs/reference/wire.md defines the columns and the bit fields, codec/encoded_voxels.py the elements.
#include <nanobind/nanobind.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <tuple>

namespace nb = nanobind;

namespace {

static_assert(std::endian::native == std::endian::little);

constexpr int kMaxFineBits = 15, kMaxCoarseBits = 5, kStepsPerOctave = 7;
constexpr int kOpacityBits = 6, kTargetBits = 7, kMaxTarget = (1 << kTargetBits) - 2;
constexpr int kQuatZero = 128, kMaxColourCode = 128;
// Shorter work than this is done before another thread of Python would notice.
constexpr size_t kLockedElements = 1 << 14;

#pragma pack(push, 1)
struct Voxel {
  int64_t key;
  uint64_t update_seq, kappa_sum;
  uint32_t count;
};
struct Codes {
  uint16_t fractions[3];
  uint8_t scales[3], quats[3], largest_and_opacity, rgb[3], active_and_target;
  uint32_t kappa;
};
#pragma pack(pop)
static_assert(sizeof(Voxel) == 28 && sizeof(Codes) == 21);

void require(bool holds, const char* message) {
  if (!holds) throw std::invalid_argument(message);
}

// Counts and widths of a message's header.
struct Layout {
  size_t voxels, gaussians, kappa_bytes, target_bytes;
  int coarse_bits, scale_code;

  size_t frame_bytes() const {
    return voxels * 20 + gaussians * (12 + kappa_bytes + target_bytes) + (gaussians + 7) / 8;
  }
};

// A column of numbers: all first bytes, then all second bytes, and so on.
struct Column {
  const uint8_t* data;
  size_t count, width;

  uint64_t operator[](size_t i) const {
    uint64_t value = 0;
    for (size_t place = 0; place < width; ++place) value |= uint64_t(data[place * count + i]) << 8 * place;
    return value;
  }
};

// Bit fields of at most 15 bits, from one place of the data on; reads no byte beyond the data.
class BitFields {
 public:
  BitFields(const uint8_t* data, size_t size, size_t first_bit) : data_(data), size_(size), bit_(first_bit) {}

  uint32_t take(int width) {
    const size_t first = bit_ >> 3;
    uint32_t window = 0;
    if (first + 4 <= size_)
      std::memcpy(&window, data_ + first, 4);
    else
      for (size_t i = first; i < size_; ++i) window |= uint32_t(data_[i]) << (8 * (i - first));
    const uint32_t value = window >> (bit_ & 7) & ((1u << width) - 1);
    bit_ += size_t(width);
    return value;
  }

 private:
  const uint8_t* data_;
  size_t size_, bit_;
};

// The three indices that each Morton code interleaves, x highest.
const std::array<std::array<uint8_t, 3>, 1 << 3 * kMaxCoarseBits>& coarse_cells() {
  static const auto cells = [] {
    std::array<std::array<uint8_t, 3>, 1 << 3 * kMaxCoarseBits> all{};
    for (size_t code = 0; code < all.size(); ++code)
      for (int bit = 0; bit < 3 * kMaxCoarseBits; ++bit)
        all[code][size_t(2 - bit % 3)] |= uint8_t((code >> bit & 1) << bit / 3);
    return all;
  }();
  return cells;
}

// Bits per axis of a position by the code of the smallest scale.
std::array<uint8_t, 256> bits_by_scale(const Layout& layout) {
  std::array<uint8_t, 256> bits;
  for (int code = 0; code < 256; ++code) {
    const int steps = std::max(layout.scale_code - code, 0);
    const int octaves = (steps + kStepsPerOctave - 1) / kStepsPerOctave;
    bits[size_t(code)] = uint8_t(std::clamp(octaves, layout.coarse_bits, kMaxFineBits));
  }
  return bits;
}

// The voxels of a message and its Gaussians, in one pass over the columns and one over the bit fields.
class Unpacker {
 public:
  Unpacker(const Layout& layout, const uint8_t* frame, const uint8_t* quat_steps)
      : layout_(layout), quat_steps_(quat_steps), bits_by_scale_(bits_by_scale(layout)), voxel_columns_(frame),
        lengths_(frame + 20 * layout.voxels), kappas_(lengths_ + 12 * layout.gaussians),
        targets_(kappas_ + layout.kappa_bytes * layout.gaussians),
        active_(targets_ + layout.target_bytes * layout.gaussians) {}

  // Keys, counts and stated rest of the kappa sums.
  void voxels(Voxel* out, uint64_t update_seq) const {
    const size_t n = layout_.voxels;
    const Column keys{voxel_columns_, n, 8}, sums{voxel_columns_ + 8 * n, n, 8}, counts{voxel_columns_ + 16 * n, n, 4};
    uint64_t key = 0, total = 0;
    for (size_t i = 0; i < n; ++i) {
      key += keys[i];
      out[i] = {int64_t(key), update_seq, sums[i], uint32_t(counts[i])};
      total += out[i].count;
      require(out[i].key >= 0, "expected voxel keys of at least 0, got a negative one");
      require(i == 0 || out[i].key > out[i - 1].key, "expected strictly ascending voxel keys, got others");
    }
    if (total != layout_.gaussians)
      throw std::invalid_argument("voxel counts sum to " + std::to_string(total) + ", expected " +
                                  std::to_string(layout_.gaussians));
  }

  // Everything of the Gaussians but their positions.
  void labels(Codes* out) {
    const size_t n = layout_.gaussians;
    const uint8_t *scales = lengths_ + n, *quats = lengths_ + 4 * n, *opacities = quats + 4 * n, *rgb = opacities + n;
    const Column kappas{kappas_, n, layout_.kappa_bytes};
    const uint32_t kappa_mask = uint32_t((uint64_t(1) << 8 * layout_.kappa_bytes) - 1);
    uint32_t kappa = 0;
    uint8_t scale = 0, colour[3] = {};
    for (size_t i = 0; i < n; ++i) {
      Codes& code = out[i];
      scale = uint8_t(scale + scales[i]);
      code.scales[0] = scale;
      for (size_t axis = 1; axis < 3; ++axis) code.scales[axis] = uint8_t(scale + scales[axis * n + i]);
      const auto [smallest, largest] = std::minmax({code.scales[0], code.scales[1], code.scales[2]});
      const int steps = quat_steps_[largest - smallest];
      bool is_rotation = quats[i] <= 3, is_colour = true;
      for (size_t part = 0; part < 3; ++part) {
        code.quats[part] = quats[(part + 1) * n + i];
        is_rotation &= std::abs(code.quats[part] - kQuatZero) <= steps;
        colour[part] = uint8_t(colour[part] + rgb[part * n + i]);
        is_colour &= colour[part] <= kMaxColourCode;
        code.rgb[part] = colour[part];
      }
      require(is_rotation, "quats: expected an index of 0 to 3 and components up to the largest, got others");
      require(is_colour, "rgb: expected codes up to 128, got a larger one");
      require(opacities[i] < 1 << kOpacityBits, "opacities: expected codes below 64, got a larger one");
      code.largest_and_opacity = uint8_t(quats[i] << kOpacityBits | opacities[i]);
      kappa = (kappa + uint32_t(kappas[i])) & kappa_mask;
      code.kappa = kappa;
      const int label = std::clamp(int(target(i)), -1, kMaxTarget);
      has_wide_targets_ |= label != target(i);
      code.active_and_target = uint8_t((active_[i / 8] >> i % 8 & 1) << kTargetBits | (label + 1));
    }
  }

  // The positions of the bit fields, and the sum of kappa of each voxel. Overwrites nothing else.
  void positions(Codes* out, Voxel* voxels, const uint8_t* data, size_t size, bool adds_stated) const {
    const auto [delta_bits, fine_bits] = field_bits(out);
    require((delta_bits + 3 * fine_bits + 7) / 8 == size, "positions: expected another number of bytes of bit fields");
    const size_t unused_bit = (delta_bits + 3 * fine_bits) % 8;
    require(unused_bit == 0 || data[size - 1] >> unused_bit == 0, "expected zeros after the last bit field, got others");
    BitFields deltas(data, size, 0);
    BitFields low[3] = {{data, size, delta_bits}, {data, size, delta_bits + fine_bits},
                        {data, size, delta_bits + 2 * fine_bits}};
    const auto& coarse = coarse_cells();
    Codes* code = out;
    for (Voxel* voxel = voxels; voxel != voxels + layout_.voxels; ++voxel) {
      uint64_t sum = adds_stated ? voxel->kappa_sum : 0;
      uint32_t morton = 0;
      for (const Codes* end = code + voxel->count; code != end; ++code) {
        const int length = lengths_[code - out], bits = position_bits(*code), fine = bits - layout_.coarse_bits;
        // the highest bit of a difference is always one, so it is not stored
        if (length) morton += deltas.take(length - 1) | 1u << (length - 1);
        require(morton >> 3 * layout_.coarse_bits == 0, "positions: expected cells inside their voxels, got one outside");
        for (size_t axis = 0; axis < 3; ++axis) {
          const uint32_t cell = low[axis].take(fine) | uint32_t(coarse[morton][axis]) << fine;
          code->fractions[axis] = uint16_t((2 * cell + 1) << (kMaxFineBits - bits));
        }
        sum += code->kappa;
      }
      voxel->kappa_sum = sum;
    }
  }

  bool has_wide_targets() const { return has_wide_targets_; }

  int16_t target(size_t i) const {
    const uint8_t low = targets_[i];
    return layout_.target_bytes == 1 ? int8_t(low) : int16_t(low | targets_[layout_.gaussians + i] << 8);
  }

 private:
  int position_bits(const Codes& code) const {
    return bits_by_scale_[std::min({code.scales[0], code.scales[1], code.scales[2]})];
  }

  // Bits of all differences, and of all low bits of one axis.
  std::pair<size_t, size_t> field_bits(const Codes* codes) const {
    size_t delta_bits = 0, fine_bits = 0;
    for (size_t i = 0; i < layout_.gaussians; ++i) {
      require(lengths_[i] <= 3 * layout_.coarse_bits, "positions: expected shorter differences, got a longer one");
      delta_bits += size_t(std::max(lengths_[i] - 1, 0));
      fine_bits += size_t(position_bits(codes[i]) - layout_.coarse_bits);
    }
    return {delta_bits, fine_bits};
  }

  Layout layout_;
  const uint8_t* quat_steps_;
  std::array<uint8_t, 256> bits_by_scale_;
  const uint8_t *voxel_columns_, *lengths_, *kappas_, *targets_, *active_;
  bool has_wide_targets_ = false;
};

const uint8_t* data_of(const nb::bytes& bytes) { return static_cast<const uint8_t*>(bytes.data()); }

template <class T>
nb::bytes new_bytes(size_t count) {
  PyObject* bytes = PyBytes_FromStringAndSize(nullptr, Py_ssize_t(count * sizeof(T)));
  if (!bytes) throw nb::python_error();
  return nb::steal<nb::bytes>(bytes);
}

template <class T>
T* elements(nb::bytes& bytes) {
  return reinterpret_cast<T*>(PyBytes_AsString(bytes.ptr()));
}

std::tuple<nb::bytes, nb::bytes, nb::bytes> unpack(
    const nb::bytes& frame, const nb::bytes& fields, const std::tuple<size_t, size_t, size_t, size_t, int, int>& widths,
    const nb::bytes& quat_steps, uint64_t update_seq, bool adds_stated) {
  const auto [voxel_count, count, kappa_bytes, target_bytes, coarse_bits, scale_code] = widths;
  const Layout layout{voxel_count, count, kappa_bytes, target_bytes, coarse_bits, scale_code};
  require(std::max(voxel_count, count) <= UINT32_MAX, "expected counts of 32 bits");
  require(kappa_bytes >= 1 && kappa_bytes <= 4 && target_bytes >= 1 && target_bytes <= 2, "unknown column widths");
  require(coarse_bits >= 0 && coarse_bits <= kMaxCoarseBits, "expected at most 5 coarse bits");
  require(quat_steps.size() == 256, "expected 256 numbers of steps");
  // the outputs are at most twice as long as these bytes, which the caller has already
  require(frame.size() == layout.frame_bytes(), "expected a frame of another size");
  nb::bytes voxels = new_bytes<Voxel>(voxel_count), codes = new_bytes<Codes>(count);
  Unpacker unpacker(layout, data_of(frame), data_of(quat_steps));
  const auto run = [&] {
    unpacker.voxels(elements<Voxel>(voxels), update_seq);
    unpacker.labels(elements<Codes>(codes));
    unpacker.positions(elements<Codes>(codes), elements<Voxel>(voxels), data_of(fields), fields.size(), adds_stated);
  };
  if (voxel_count + count > kLockedElements) {
    nb::gil_scoped_release released;
    run();
  } else {
    run();
  }
  nb::bytes targets = new_bytes<int16_t>(unpacker.has_wide_targets() ? count : 0);
  for (size_t i = 0; i < targets.size() / 2; ++i) {
    const int16_t target = unpacker.target(i);
    std::memcpy(elements<char>(targets) + 2 * i, &target, 2);
  }
  return {voxels, codes, targets};
}

}  // namespace

NB_MODULE(_unpack, m) {
  m.doc() = "Unpacks the bodies of quantised messages; use gausslite.codec.subset_codec.";
  m.def("unpack", &unpack, nb::arg("frame"), nb::arg("fields"), nb::arg("widths"), nb::arg("quat_steps"),
        nb::arg("update_seq"), nb::arg("adds_stated"),
        "Return VOXELS, CODES, and the targets (int16) if some do not fit the codes. Raises ValueError.");
}
