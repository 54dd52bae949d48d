// SPDX-License-Identifier: Apache-2.0
#include "adam_corrections.h"

#include <algorithm>
#include <cmath>

namespace gausslite {

const float* AdamCorrections::table(double beta1, double beta2, double decay_after_updates) {
  if (beta1 != beta1_ || beta2 != beta2_ || decay_after_updates != decay_after_updates_) {
    table_.ensure_capacity(2 * size_t(kCount));
    for (int t = 1; t <= kCount; ++t) {
      const double rate = std::sqrt(std::min(1.0, decay_after_updates / t));
      table_[2 * size_t(t - 1)] = float(rate / (1.0 - std::pow(beta1, t)));
      table_[2 * size_t(t - 1) + 1] = float(1.0 / (1.0 - std::pow(beta2, t)));
    }
    beta1_ = beta1;
    beta2_ = beta2;
    decay_after_updates_ = decay_after_updates;
  }
  return table_.data();
}

}  // namespace gausslite
