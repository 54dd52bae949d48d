// SPDX-License-Identifier: Apache-2.0
#include "training_view.h"

#include <algorithm>
#include <cmath>

namespace gausslite {

namespace {

enum Plane { kRgbPlane = 0, kDepthPlane = 3, kInsidePlane = 4, kMaskPlane = 5, kMomentPlanes = 6, kPlanes = 12 };

int padded(int pixels) { return (pixels + kTile - 1) / kTile * kTile; }

}  // namespace

TrainingView::TrainingView(const Stages& stages, int width, int height, const uint8_t* rgb, const float* depth_m,
                           const float* weight)
    : width_(width),
      height_(height),
      padded_width_(padded(width)),
      plane_(int64_t(padded_width_) * padded(height)),
      masked_(weight != nullptr),
      inside_{kInsidePlane, 0.0, {}, {}},
      mask_{kMaskPlane, 0.0, {}, {}} {
  planes_.reserve(size_t(plane_) * kPlanes);
  float* p = planes_.data();
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const int64_t from = int64_t(y) * width + x, to = int64_t(y) * padded_width_ + x;
      for (int k = 0; k < 3; ++k) p[(kRgbPlane + k) * plane_ + to] = float(rgb[3 * from + k]) / 255.0f;
      // Whatever a sensor writes for "no return", a depth that is not a positive number is not compared.
      p[kDepthPlane * plane_ + to] = std::isfinite(depth_m[from]) && depth_m[from] > 0.0f ? depth_m[from] : 0.0f;
      p[kInsidePlane * plane_ + to] = 1.0f;
      if (masked_) p[kMaskPlane * plane_ + to] = weight[from];
    }
  }
  locate(inside_);
  if (masked_) locate(mask_);
  Buffer<float> scratch;
  scratch.reserve(stages.ssim_scratch_floats(padded_width_));
  stages.prepare_ssim(p, width, height, padded_width_, plane_, p + kMomentPlanes * plane_, scratch.data());
}

void TrainingView::locate(Weights& weights) const {
  const int tiles_x = padded_width_ / kTile;
  weights.spans.reserve(2 * size_t(height_));
  weights.tiles.reserve(size_t(plane_) / (kTile * kTile));
  for (int y = 0; y < height_; ++y) {
    const float* row = planes_.data() + weights.plane * plane_ + int64_t(y) * padded_width_;
    int begin = width_, end = 0;
    for (int x = 0; x < width_; ++x) {
      if (row[x] == 0.0f) continue;
      begin = std::min(begin, x);
      end = x + 1;
      weights.sum += double(row[x]);
      weights.tiles[size_t(y / kTile) * size_t(tiles_x) + size_t(x / kTile)] = 1;
    }
    weights.spans[2 * size_t(y)] = uint16_t(std::min(begin, end));
    weights.spans[2 * size_t(y) + 1] = uint16_t(end);
  }
}

Targets TrainingView::targets(bool masked) const {
  const Weights& w = weights(masked);
  const float* p = planes_.data();
  return {
      p, p + kDepthPlane * plane_, p + w.plane * plane_, p + kMomentPlanes * plane_, w.tiles.data(), w.spans.data()};
}

}  // namespace gausslite
