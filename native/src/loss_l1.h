// SPDX-License-Identifier: Apache-2.0
// The L1 terms of Eq. (2) on sixteen pixels: colour, and expected depth D / A where there is a surface and a
// measurement.
#pragma once

#include "simd/pack.h"
#include "stages.h"

namespace gausslite::GAUSSLITE_ISA {

// d|x|/dx times `size`; 0 at 0.
GAUSSLITE_INLINE Pack16 sign_times(Pack16 x, Pack16 size) {
  const Pack16 zero(0.0f);
  return zero_unless(x > zero, size) - zero_unless(x < zero, size);
}

// image: r g b depth transmittance; gradient: by r g b depth alpha. Returns the loss of each pixel.
GAUSSLITE_INLINE Pack16 l1_of_pixels(const Pack16 (&image)[5], const Pack16 (&training_rgb)[3], Pack16 measured_m,
                                     Pack16 weight, const LossSettings& settings, Pack16 (&gradient)[5]) {
  const Pack16 colour = weight * settings.colour;
  Pack16 loss(0.0f);
  for (int k = 0; k < 3; ++k) {
    const Pack16 difference = image[k] - training_rgb[k];
    loss = fma(abs(difference), colour, loss);
    gradient[k] = sign_times(difference, colour);
  }
  const Pack16 alpha = Pack16(1.0f) - image[4];
  const Mask16 compared = (alpha > Pack16(kMinSurfaceAlpha)) & (measured_m > Pack16(0.0f));
  const Pack16 depth = zero_unless(compared, weight * settings.depth);
  const Pack16 inverse_alpha = Pack16(1.0f) / max(alpha, Pack16(kMinSurfaceAlpha));
  const Pack16 expected_m = image[3] * inverse_alpha, difference = expected_m - measured_m;
  loss = fma(abs(difference), depth, loss);
  gradient[3] = sign_times(difference, depth) * inverse_alpha;
  gradient[4] = -(gradient[3] * expected_m);
  return loss;
}

}  // namespace gausslite::GAUSSLITE_ISA
