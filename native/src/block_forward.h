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
  return fnma(y_part, dy, fnma(x_part, dx, Pack16(s.log2_opacity)));
}

// Composites a list until it ends or all sixteen pixels are finished; returns how many entries it took. With
// kKeepAlphas they are appended at `alphas`, for the way back.
template <bool kKeepAlphas>
GAUSSLITE_INLINE int composite(const Splat* records, const uint8_t* list, int n, Pack16 pixel_x, Pack16 pixel_y,
                               BlockState& state, float*& alphas) {
  BlockState s = state;
  Mask16 open = s.transmittance >= Pack16(kMinTransmittance);
  int i = 0;
  while (i < n) {
    const Splat& splat = records[list[i++]];
    const Pack16 exponent = log2_alpha(splat, pixel_x, pixel_y);
    const Mask16 counts = open & (exponent >= Pack16(kLog2MinAlpha));
    const Pack16 alpha = keep(counts, exp2_fast(min(exponent, Pack16(kLog2MaxAlpha))));
    if (kKeepAlphas) {
      store(alphas, alpha);
      alphas += 16;
    }
    const Pack16 weight = alpha * s.transmittance;
    s.r = fma(weight, Pack16(splat.r), s.r);
    s.g = fma(weight, Pack16(splat.g), s.g);
    s.b = fma(weight, Pack16(splat.b), s.b);
    s.depth = fma(weight, Pack16(splat.depth), s.depth);
    s.transmittance = s.transmittance - weight;
    open = s.transmittance >= Pack16(kMinTransmittance);
    if (!any(open)) break;
  }
  state = s;
  return i;
}

}  // namespace gausslite::GAUSSLITE_ISA
