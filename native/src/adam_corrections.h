// SPDX-License-Identifier: Apache-2.0
// Adam's bias corrections by number of updates, computed once per pair of betas.
#pragma once

#include "memory.h"

namespace gausslite {

class AdamCorrections {
 public:
  // 0.999^t is below single precision's resolution of 1 after some 17 000 updates.
  static constexpr int kCount = 20'000;

  // 1 / (1 - beta1^t), 1 / (1 - beta2^t) for t = 1 ... kCount; valid until the next call.
  const float* table(double beta1, double beta2);

 private:
  Buffer<float> table_;
  double beta1_ = -1.0, beta2_ = -1.0;
};

}  // namespace gausslite
