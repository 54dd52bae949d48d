// SPDX-License-Identifier: Apache-2.0
// Stage 5a: the L1 terms on whole image rows, for iterations whose SSIM term needs the finished image. Pixels without a
// weight, among them the padding, get the gradient 0.
#include "loss_l1.h"

#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

void loss_l1(Workspace& ws, const Training& training, int begin, int end) {
  const Targets& t = training.targets;
  for (int y = begin; y < end; ++y) {
    double row_loss = 0.0;
    for (int x = 0; x < ws.padded_width; x += 16) {
      const int64_t at = int64_t(y) * ws.padded_width + x;
      Pack16 image[5], rgb[3], gradient[5];
      for (int k = 0; k < 5; ++k) image[k] = load(ws.image.data() + k * ws.plane + at);
      for (int k = 0; k < 3; ++k) rgb[k] = load(t.rgb + k * ws.plane + at);
      row_loss +=
          double(sum(l1_of_pixels(image, rgb, load(t.depth_m + at), load(t.weight + at), training.loss, gradient)));
      for (int k = 0; k < 5; ++k) store(ws.image_gradient.data() + k * ws.plane + at, gradient[k]);
    }
    training.loss_sums[y] = row_loss;
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
