// SPDX-License-Identifier: Apache-2.0
// Columns of the 64-byte rows of parameters, moments and image gradients; the same as in render/rasterizer.py.
#pragma once

namespace gausslite {

constexpr int kRowWidth = 16;

// Parameters, gradients and Adam's moments.
constexpr int kMean = 0, kLogScale = 3, kQuat = 6, kLogit = 10, kRgb = 11, kTrainedColumns = 14;
// Column of the parameter rows: number of Adam updates.
constexpr int kUpdates = 14;
// Columns of the first moment: sum of the norms of the 2D mean's gradient, and number of steps in which the splat was
// visible.
constexpr int kGradSum = 14, kGradCount = 15;

// Image gradient rows, written by the raster stages and read by the projection's backward pass. v = dL/d ln(alpha) at a
// pixel at offset (x, y) from the splat's mean; w is its blending weight. Columns 0-5: sums of v, v x, v y, v x x, v x
// y, v y y. 8-11: sums of w dL/d(r, g, b, depth). 15: the number of the pass that wrote the row. The others are unused.
constexpr int kMoments = 0, kColourSums = 8, kRowPass = 15;

}  // namespace gausslite
