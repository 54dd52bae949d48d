// SPDX-License-Identifier: Apache-2.0
// Copies between the workspace's planes of whole tiles and the caller's images.
#pragma once

#include "workspace.h"

namespace gausslite {

struct ImageOutput {
  float* rgb;      // height x width x 3
  float* depth_m;  // height x width
  float* alpha;    // height x width
};

struct ImageGradients {
  const float* d_rgb;
  const float* d_depth_m;
  const float* d_alpha;
};

// Copies rows [begin, end) of the rendered image to the output.
void export_image(const Workspace& ws, const ImageOutput& output, int begin, int end);
// Copies rows [begin, end) of the gradients to the padded planes; sets pixels beyond the image to zero.
void import_gradients(Workspace& ws, const ImageGradients& input, int begin, int end);

}  // namespace gausslite
