// SPDX-License-Identifier: Apache-2.0
// Columns of the 64-byte rows of parameters, moments and image gradients; the same as in render/rasterizer.py.
#pragma once

namespace gausslite {

constexpr int kRowWidth = 16;

// First columns of the parameters, of their gradients and of Adam's moments.
constexpr int kMean = 0, kLogScale = 3, kQuat = 6, kLogit = 10, kRgb = 11;
// Number of trained columns: those above. The last two have other uses.
constexpr int kTrainedColumns = 14;
// Column of the parameter rows: number of Adam updates.
constexpr int kUpdates = 14;
// Columns of the table of first moments, for density control: sum of the norms of the 2D mean's gradient, and number of
// steps in which the splat was visible.
constexpr int kGradSum = 14, kGradCount = 15;

// Rows of image gradients, written by the raster stages and read by the projection's backward pass. Each belongs to one
// pair of a splat and a tile row. At a pixel at offset (x, y) from the splat's mean, v = dL/d ln(alpha), and w is the
// blending weight. The columns are:
// - 0-5: spatial moments, the sums over the pixels of v, v·x, v·y, v·x², v·x·y, v·y²;
// - 8-11: sums of w·dL/d(r, g, b, depth);
// - 15: number of the backward pass that wrote the row (Workspace::gradient_pass); other columns are unused.
constexpr int kGradientMoments = 0, kColourSums = 8, kPassNumber = 15;

}  // namespace gausslite
