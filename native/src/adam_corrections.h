// SPDX-License-Identifier: Apache-2.0
// Table of the factors of Adam's step that depend on a splat's number of updates, computed once per setting.
#pragma once

#include "memory.h"

namespace gausslite {

class AdamCorrections {
 public:
  // 0.999^t is below the float resolution of 1 after about 17 000 updates. The rates do not decay further either.
  static constexpr int kCount = 20'000;

  // Returns rate(t) / (1 - beta1^t), 1 / (1 - beta2^t) for t = 1 ... kCount, with rate(t) = min(1,
  // sqrt(decay_after_updates / t)); valid until the next call.
  const float* table(double beta1, double beta2, double decay_after_updates);

 private:
  Buffer<float> table_;
  double beta1_ = -1.0, beta2_ = -1.0, decay_after_updates_ = -1.0;
};

}  // namespace gausslite
