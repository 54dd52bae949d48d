// SPDX-License-Identifier: Apache-2.0
// What Adam's step is multiplied by for a splat's number of updates, computed once per rule.
#pragma once

#include "memory.h"

namespace gausslite {

class AdamCorrections {
 public:
  // 0.999^t is below single precision's resolution of 1 after some 17 000 updates. Rates fall no further either.
  static constexpr int kCount = 20'000;

  // rate(t) / (1 - beta1^t), 1 / (1 - beta2^t) for t = 1 ... kCount, where the rate is 1 for the first
  // decay_after_updates and falls with the root of the updates after them; valid until the next call.
  const float* table(double beta1, double beta2, double decay_after_updates);

 private:
  Buffer<float> table_;
  double beta1_ = -1.0, beta2_ = -1.0, full_rate_updates_ = -1.0;
};

}  // namespace gausslite
