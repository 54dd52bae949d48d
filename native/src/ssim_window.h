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

// set(i, windowed sum around get(i + kRadius)) for i = 0 ... 15, in packs of one kind. Each of the 26 packs is fetched
// once, in order, and stays in a register while the window passes over it.
template <class Pack, class Get, class Set>
GAUSSLITE_INLINE void blur_packs(Get get, Set set) {
  Pack seen[kSpan];
#pragma GCC unroll 32
  for (int i = 0; i < kTaps - 1; ++i) seen[i] = get(i);
#pragma GCC unroll 32
  for (int i = 0; i < kTile; ++i) {
    seen[i + kTaps - 1] = get(i + kTaps - 1);
    Pack total = seen[i + kRadius] * kWindow[0];
#pragma GCC unroll 8
    for (int k = 1; k <= kRadius; ++k)
      total = fma(seen[i + kRadius - k] + seen[i + kRadius + k], Pack(kWindow[k]), total);
    set(i, total);
  }
}

// The same for sixteen floats at a time; in halves where the window would not fit the registers otherwise.
template <class Get, class Set>
GAUSSLITE_INLINE void blur(Get get, Set set) {
  if constexpr (kOneRegister) {
    blur_packs<Pack16>(get, set);
  } else {
    Pack8 sums[kTile];
    blur_packs<Pack8>([&](int i) { return lower(get(i)); }, [&](int i, Pack8 sum) { sums[i] = sum; });
    blur_packs<Pack8>([&](int i) { return upper(get(i)); }, [&](int i, Pack8 sum) { set(i, join(sums[i], sum)); });
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
