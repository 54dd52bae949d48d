// SPDX-License-Identifier: Apache-2.0
// Front-to-back compositing of one 4x4 block of pixels, with its state in registers. An entry is the index of a splat
// in the tile's current chunk (Workspace's kChunk).
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
  return zero_unless(exponent >= Pack16(kLog2MinAlpha), exp2_fast(min(exponent, Pack16(kLog2MaxAlpha))));
}

// A block during compositing. A pixel is finished when its transmittance is below kMinTransmittance; it then does not
// change.
template <bool kKeepAlphas>
class BlockCompositor {
 public:
  GAUSSLITE_INLINE BlockCompositor(const BlockState& state, float* alphas)
      : state_(state), running_transmittance_(state.transmittance), alphas_(alphas) {}

  GAUSSLITE_INLINE BlockState state() const {
    BlockState out = state_;
    if constexpr (!kFitsOneRegister) out.transmittance = running_transmittance_;
    return out;
  }
  GAUSSLITE_INLINE float* alphas() const { return alphas_; }
  GAUSSLITE_INLINE bool any_unfinished() const { return any(is_unfinished()); }

  GAUSSLITE_INLINE void add(const Splat& splat, Pack16 alpha) {
    const Mask16 unfinished = is_unfinished();
    const Pack16 masked_alpha = zero_unless(unfinished, alpha);
    if (kKeepAlphas) {
      store(alphas_, masked_alpha);
      alphas_ += 16;
    }
    const Pack16 weight = masked_alpha * running_transmittance_;
    state_.r = fma(weight, Pack16(splat.r), state_.r);
    state_.g = fma(weight, Pack16(splat.g), state_.g);
    state_.b = fma(weight, Pack16(splat.b), state_.b);
    state_.depth = fma(weight, Pack16(splat.depth), state_.depth);
    if constexpr (kFitsOneRegister) {
      // The dependency chain is one fused step per entry.
      running_transmittance_ = fnma(alpha, running_transmittance_, running_transmittance_);
      state_.transmittance = select(unfinished, running_transmittance_, state_.transmittance);
    } else {
      // The other variants lack the registers for a second transmittance, and other work hides the latency.
      running_transmittance_ = running_transmittance_ - weight;
    }
  }

 private:
  GAUSSLITE_INLINE Mask16 is_unfinished() const { return running_transmittance_ >= Pack16(kMinTransmittance); }

  BlockState state_;
  // With kFitsOneRegister it continues to decrease in finished pixels, and state_.transmittance is the result.
  // Otherwise it is the result.
  Pack16 running_transmittance_;
  float* alphas_;
};

// Composites a list until it ends or all sixteen pixels are finished; returns the number of composited entries.
// kKeepAlphas: appends the alphas at `alphas`, for the backward pass.
template <bool kKeepAlphas>
GAUSSLITE_INLINE int composite(const Splat* records, const uint8_t* list, int n, Pack16 pixel_x, Pack16 pixel_y,
                               BlockState& state, float*& alphas) {
  if (n == 0) return 0;
  BlockCompositor<kKeepAlphas> block(state, alphas);
  const auto splat = [&](int i) -> const Splat& { return records[list[i]]; };
  const auto alpha = [&](int i) { return alpha_of(splat(i), pixel_x, pixel_y); };
  int composited = 0;
  // Two alphas at a time: a core's out-of-order window is too small to overlap them by itself. With enough registers
  // the next two are computed while these are added: lists are padded, so that this may read behind their end.
  if constexpr (kFitsOneRegister) {
    Pack16 first = alpha(0), second = alpha(1);
    for (; composited + 1 < n && block.any_unfinished(); composited += 2) {
      const Pack16 third = alpha(composited + 2), fourth = alpha(composited + 3);
      block.add(splat(composited), first);
      block.add(splat(composited + 1), second);
      first = third;
      second = fourth;
    }
    if (composited < n && block.any_unfinished()) block.add(splat(composited++), first);
  } else {
    for (; composited + 1 < n && block.any_unfinished(); composited += 2) {
      const Pack16 first = alpha(composited), second = alpha(composited + 1);
      block.add(splat(composited), first);
      block.add(splat(composited + 1), second);
    }
    if (composited < n && block.any_unfinished()) {
      block.add(splat(composited), alpha(composited));
      ++composited;
    }
  }
  state = block.state();
  alphas = block.alphas();
  return composited;
}

}  // namespace gausslite::GAUSSLITE_ISA
