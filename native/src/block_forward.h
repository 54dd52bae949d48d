// SPDX-License-Identifier: Apache-2.0
// Compositing one 4x4 block of pixels front to back, its whole state in registers.
#pragma once

#include "simd/pack.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

// Sixteen pixels: accumulated colour and depth, and the transmittance that is left.
struct BlockState {
  Pack16 r{0.0f}, g{0.0f}, b{0.0f}, depth{0.0f}, transmittance{1.0f};

  GAUSSLITE_INLINE bool finished() const { return !any(transmittance >= Pack16(kMinTransmittance)); }
};

GAUSSLITE_INLINE Pack16 log2_alpha(const Splat& s, Pack16 pixel_x, Pack16 pixel_y) {
  const Pack16 dx = pixel_x - s.mean_x, dy = pixel_y - s.mean_y;
  const Pack16 x_part = fma(Pack16(s.quad_xy), dy, dx * s.quad_xx), y_part = dy * s.quad_yy;
  return fnma(x_part, dx, fnma(y_part, dy, Pack16(s.log2_opacity)));
}

// What the splat covers of sixteen pixels.
GAUSSLITE_INLINE Pack16 alpha_of(const Splat& splat, Pack16 pixel_x, Pack16 pixel_y) {
  const Pack16 exponent = log2_alpha(splat, pixel_x, pixel_y);
  return keep(exponent >= Pack16(kLog2MinAlpha), exp2_fast(min(exponent, Pack16(kLog2MaxAlpha))));
}

// Composites a list until it ends or all sixteen pixels are finished; returns how many entries it took. With
// kKeepAlphas they are appended at `alphas`, for the way back.
template <bool kKeepAlphas>
GAUSSLITE_INLINE int composite(const Splat* records, const uint8_t* list, int n, Pack16 pixel_x, Pack16 pixel_y,
                               BlockState& state, float*& alphas) {
  BlockState s = state;
  // What would be left if no pixel ever finished. One fused step an entry is all that an entry waits for.
  Pack16 unfinished = s.transmittance;
  Mask16 open = unfinished >= Pack16(kMinTransmittance);
  const auto add = [&](const Splat& splat, Pack16 alpha) {
    const Pack16 open_alpha = keep(open, alpha);
    if (kKeepAlphas) {
      store(alphas, open_alpha);
      alphas += 16;
    }
    const Pack16 weight = open_alpha * unfinished;
    s.r = fma(weight, Pack16(splat.r), s.r);
    s.g = fma(weight, Pack16(splat.g), s.g);
    s.b = fma(weight, Pack16(splat.b), s.b);
    s.depth = fma(weight, Pack16(splat.depth), s.depth);
    unfinished = fnma(alpha, unfinished, unfinished);
    s.transmittance = select(open, unfinished, s.transmittance);
    open = unfinished >= Pack16(kMinTransmittance);
  };
  int taken = 0;
  // Two alphas side by side: a core does not look far enough ahead to find the second one's work by itself.
  for (; taken + 1 < n && any(open); taken += 2) {
    const Splat &first = records[list[taken]], &second = records[list[taken + 1]];
    const Pack16 alpha = alpha_of(first, pixel_x, pixel_y), next_alpha = alpha_of(second, pixel_x, pixel_y);
    add(first, alpha);
    add(second, next_alpha);
  }
  if (taken < n && any(open)) {
    const Splat& last = records[list[taken++]];
    add(last, alpha_of(last, pixel_x, pixel_y));
  }
  state = s;
  return taken;
}

}  // namespace gausslite::GAUSSLITE_ISA
