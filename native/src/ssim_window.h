// SPDX-License-Identifier: Apache-2.0
// The SSIM window, an 11-tap Gaussian, applied to sixteen packs at a time.
#pragma once

#include "simd/pack.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

constexpr int kRadius = 5, kTaps = 2 * kRadius + 1;
constexpr int kSpan = kTileSide + 2 * kRadius;  // rows or columns that the windows of an SSIM square reach

// The maps of an SSIM square as zeros, for squares beyond the image or without a gradient.
alignas(64) inline constexpr float kZeroSquares[kSsimMaps * kTilePixels] = {};

// Gaussian of sigma 1.5 px, normalised over its 11 taps; element k is the weight at distance k.
constexpr float kWindow[kRadius + 1] = {0.26601171f, 0.21300553f, 0.10936070f, 0.03600077f, 0.00759876f, 0.00102838f};

// Calls set(i, windowed sum around get(i + kRadius)) for i = 0 ... 15. Each of the 26 packs is loaded once, in order,
// and stays in a register while the window passes over it.
template <class Pack, class Get, class Set>
GAUSSLITE_INLINE void blur_packs(Get get, Set set) {
  Pack window[kSpan];
#pragma GCC unroll 32
  for (int i = 0; i < kTaps - 1; ++i) window[i] = get(i);
#pragma GCC unroll 32
  for (int i = 0; i < kTileSide; ++i) {
    window[i + kTaps - 1] = get(i + kTaps - 1);
    Pack total = window[i + kRadius] * kWindow[0];
#pragma GCC unroll 8
    for (int k = 1; k <= kRadius; ++k)
      total = fma(window[i + kRadius - k] + window[i + kRadius + k], Pack(kWindow[k]), total);
    set(i, total);
  }
}

// The same for packs of sixteen floats. If a pack needs several registers, each half is blurred by itself, so that the
// window fits the registers.
template <class Get, class Set>
GAUSSLITE_INLINE void blur(Get get, Set set) {
  if constexpr (kFitsOneRegister) {
    blur_packs<Pack16>(get, set);
  } else {
    Pack8 sums[kTileSide];
    blur_packs<Pack8>([&](int i) { return lower(get(i)); }, [&](int i, Pack8 sum) { sums[i] = sum; });
    blur_packs<Pack8>([&](int i) { return upper(get(i)); }, [&](int i, Pack8 sum) { set(i, join(sums[i], sum)); });
  }
}

// Returns row i of the 26 rows that the windows of a square reach. The square is the lower half of `upper` and the
// upper half of `lower`.
GAUSSLITE_INLINE Pack16 row_between(const float* upper, const float* lower, int i) {
  constexpr int kFirst = kTileSide / 2 - kRadius;
  const int row = i + kFirst;
  return load(row < kTileSide ? upper + row * kTileSide : lower + (row - kTileSide) * kTileSide);
}

}  // namespace gausslite::GAUSSLITE_ISA
