// SPDX-License-Identifier: Apache-2.0
// Front-to-back compositing of one 4x4 block of pixels, with its state in registers.
#pragma once

#include "simd/pack.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

// Sixteen pixels: accumulated colour and depth, and remaining transmittance.
struct BlockState {
  Pack16 r{0.0f}, g{0.0f}, b{0.0f}, depth{0.0f}, transmittance{1.0f};

  GAUSSLITE_INLINE bool finished() const { return !any(transmittance >= Pack16(kMinTransmittance)); }
};

GAUSSLITE_INLINE Pack16 log2_alpha(const Splat& s, Pack16 pixel_x, Pack16 pixel_y) {
  const Pack16 dx = pixel_x - s.mean_x, dy = pixel_y - s.mean_y;
  const Pack16 x_part = fma(Pack16(s.quad_xy), dy, dx * s.quad_xx), y_part = dy * s.quad_yy;
  return fnma(x_part, dx, fnma(y_part, dy, Pack16(s.log2_opacity)));
}

// The splat's alpha at sixteen pixels.
GAUSSLITE_INLINE Pack16 alpha_of(const Splat& splat, Pack16 pixel_x, Pack16 pixel_y) {
  const Pack16 exponent = log2_alpha(splat, pixel_x, pixel_y);
  return keep(exponent >= Pack16(kLog2MinAlpha), exp2_fast(min(exponent, Pack16(kLog2MaxAlpha))));
}

// A block during compositing. Finished pixels do not change.
template <bool kKeepAlphas>
class OpenBlock {
 public:
  GAUSSLITE_INLINE OpenBlock(const BlockState& state, float* alphas)
      : s_(state), unfinished_(state.transmittance), alphas_(alphas) {}

  GAUSSLITE_INLINE BlockState state() const {
    BlockState out = s_;
    if constexpr (!kOneRegister) out.transmittance = unfinished_;
    return out;
  }
  GAUSSLITE_INLINE float* alphas() const { return alphas_; }
  GAUSSLITE_INLINE bool any_open() const { return any(open()); }

  GAUSSLITE_INLINE void add(const Splat& splat, Pack16 alpha) {
    const Mask16 open_now = open();
    const Pack16 open_alpha = keep(open_now, alpha);
    if (kKeepAlphas) {
      store(alphas_, open_alpha);
      alphas_ += 16;
    }
    const Pack16 weight = open_alpha * unfinished_;
    s_.r = fma(weight, Pack16(splat.r), s_.r);
    s_.g = fma(weight, Pack16(splat.g), s_.g);
    s_.b = fma(weight, Pack16(splat.b), s_.b);
    s_.depth = fma(weight, Pack16(splat.depth), s_.depth);
    if constexpr (kOneRegister) {
      // The dependency chain is one fused step per entry.
      unfinished_ = fnma(alpha, unfinished_, unfinished_);
      s_.transmittance = select(open_now, unfinished_, s_.transmittance);
    } else {
      // These variants lack registers for that, and other work hides the latency.
      unfinished_ = unfinished_ - weight;
    }
  }

 private:
  GAUSSLITE_INLINE Mask16 open() const { return unfinished_ >= Pack16(kMinTransmittance); }

  BlockState s_;
  // With kOneRegister: the transmittance without the end of finished pixels; else the remaining transmittance.
  Pack16 unfinished_;
  float* alphas_;
};

// Composites a list until it ends or all sixteen pixels are finished; returns the number of composited entries.
// kKeepAlphas: appends the alphas at `alphas`, for the backward pass.
template <bool kKeepAlphas>
GAUSSLITE_INLINE int composite(const Splat* records, const uint8_t* list, int n, Pack16 pixel_x, Pack16 pixel_y,
                               BlockState& state, float*& alphas) {
  if (n == 0) return 0;
  OpenBlock<kKeepAlphas> block(state, alphas);
  const auto splat = [&](int i) -> const Splat& { return records[list[i]]; };
  const auto alpha = [&](int i) { return alpha_of(splat(i), pixel_x, pixel_y); };
  int taken = 0;
  // Two alphas at a time: a core's out-of-order window is too small to overlap them by itself. With enough registers
  // they are computed while the previous two are added. Lists are padded behind their end.
  if constexpr (kOneRegister) {
    Pack16 first = alpha(0), second = alpha(1);
    for (; taken + 1 < n && block.any_open(); taken += 2) {
      const Pack16 third = alpha(taken + 2), fourth = alpha(taken + 3);
      block.add(splat(taken), first);
      block.add(splat(taken + 1), second);
      first = third;
      second = fourth;
    }
    if (taken < n && block.any_open()) block.add(splat(taken++), first);
  } else {
    for (; taken + 1 < n && block.any_open(); taken += 2) {
      const Pack16 first = alpha(taken), second = alpha(taken + 1);
      block.add(splat(taken), first);
      block.add(splat(taken + 1), second);
    }
    if (taken < n && block.any_open()) {
      block.add(splat(taken), alpha(taken));
      ++taken;
    }
  }
  state = block.state();
  alphas = block.alphas();
  return taken;
}

}  // namespace gausslite::GAUSSLITE_ISA
