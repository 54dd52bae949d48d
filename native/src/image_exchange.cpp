// SPDX-License-Identifier: Apache-2.0
#include "image_exchange.h"

namespace gausslite {

void export_image(const Workspace& ws, const ImageOutput& output, int begin, int end) {
  const float* image = ws.image.data();
  for (int y = begin; y < end; ++y) {
    for (int x = 0; x < ws.camera.width; ++x) {
      const int64_t from = int64_t(y) * ws.padded_width + x, to = int64_t(y) * ws.camera.width + x;
      for (int k = 0; k < 3; ++k) output.rgb[3 * to + k] = image[k * ws.plane_pixels + from];
      output.depth_m[to] = image[3 * ws.plane_pixels + from];
      output.alpha[to] = 1.0f - image[4 * ws.plane_pixels + from];
    }
  }
}

void import_gradients(Workspace& ws, const ImageGradients& input, int begin, int end) {
  float* gradient = ws.image_gradient.data();
  for (int y = begin; y < end; ++y) {
    for (int x = 0; x < ws.padded_width; ++x) {
      const int64_t from = int64_t(y) * ws.camera.width + x, to = int64_t(y) * ws.padded_width + x;
      const bool inside = y < ws.camera.height && x < ws.camera.width;
      for (int k = 0; k < 3; ++k) gradient[k * ws.plane_pixels + to] = inside ? input.d_rgb[3 * from + k] : 0.0f;
      gradient[3 * ws.plane_pixels + to] = inside ? input.d_depth_m[from] : 0.0f;
      gradient[4 * ws.plane_pixels + to] = inside ? input.d_alpha[from] : 0.0f;
    }
  }
}

}  // namespace gausslite
