// SPDX-License-Identifier: Apache-2.0
// Between the workspace, which keeps an image in planes of whole tiles, and the caller's images.
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

// Rows [begin, end) of the image that was drawn.
void export_image(const Workspace& ws, const ImageOutput& output, int begin, int end);
// Rows [begin, end) of the padded planes of gradients; beyond the image they are zero.
void import_gradients(Workspace& ws, const ImageGradients& input, int begin, int end);

}  // namespace gausslite
