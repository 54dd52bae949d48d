// SPDX-License-Identifier: Apache-2.0
// The window of SSIM, an 11-tap Gaussian, run along sixteen packs at a time; and how the image is cut for it.
#pragma once

#include "simd/pack.h"
#include "workspace.h"

namespace gausslite::GAUSSLITE_ISA {

constexpr int kRadius = 5, kTaps = 2 * kRadius + 1;
constexpr int kSpan = kTile + 2 * kRadius;  // rows, or columns, that the windows of a square reach

// As many maps as one square has, where there is none.
alignas(64) inline constexpr float kNoSquares[kSsimMaps * kSquare] = {};

// Gaussian of sigma 1.5 px, normalised over its 11 taps; element k is the weight at distance k.
constexpr float kWindow[kRadius + 1] = {0.26601171f, 0.21300553f, 0.10936070f, 0.03600077f, 0.00759876f, 0.00102838f};

// set(i, windowed sum around get(i + kRadius)) for i = 0 ... 15. Each of the 26 packs is fetched once, in order, and
// stays in a register while the window passes over it.
template <class Get, class Set>
GAUSSLITE_INLINE void blur(Get get, Set set) {
  Pack16 seen[kSpan];
#pragma GCC unroll 32
  for (int i = 0; i < kTaps - 1; ++i) seen[i] = get(i);
#pragma GCC unroll 32
  for (int i = 0; i < kTile; ++i) {
    seen[i + kTaps - 1] = get(i + kTaps - 1);
    Pack16 total = seen[i + kRadius] * kWindow[0];
#pragma GCC unroll 8
    for (int k = 1; k <= kRadius; ++k)
      total = fma(seen[i + kRadius - k] + seen[i + kRadius + k], Pack16(kWindow[k]), total);
    set(i, total);
  }
}

// The i-th of the 26 rows that a square's windows reach, when the square is the lower half of `upper` and the upper
// half of `lower`.
GAUSSLITE_INLINE Pack16 row_between(const float* upper, const float* lower, int i) {
  constexpr int kFirst = kTile / 2 - kRadius;
  const int row = i + kFirst;
  return load(row < kTile ? upper + row * kTile : lower + (row - kTile) * kTile);
}

}  // namespace gausslite::GAUSSLITE_ISA
