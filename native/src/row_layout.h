// SPDX-License-Identifier: Apache-2.0
// Where a splat's parameters, its moments and its image gradients sit in their 64-byte rows (render/rasterizer.py says
// the same).
#pragma once

namespace gausslite {

constexpr int kRowWidth = 16;

// Parameters, gradients and Adam's moments.
constexpr int kMean = 0, kLogScale = 3, kQuat = 6, kLogit = 10, kRgb = 11, kTrained = 14;
// Column of the parameter rows: Adam updates so far.
constexpr int kUpdates = 14;
// Columns of the first moment: summed norms of the image-mean gradient, and steps in which the splat was visible.
constexpr int kGradSum = 14, kGradCount = 15;

// Image-space gradient rows, written by the raster and read by the projection's backward pass. With v = dL/d ln(alpha)
// at a pixel whose offset from the splat's mean is (x, y): sums of v, v x, v y, v x x, v x y, v y y; two unused; sums
// of w dL/d(r, g, b, depth) with the blending weight w; three unused; and the tag that says in which frame the row was
// last written.
constexpr int kMoments = 0, kColourSums = 8, kRowTag = 15;

}  // namespace gausslite
