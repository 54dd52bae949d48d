// SPDX-License-Identifier: Apache-2.0
#include "adam_corrections.h"

#include <cmath>

namespace gausslite {

const float* AdamCorrections::table(double beta1, double beta2) {
  if (beta1 != beta1_ || beta2 != beta2_) {
    table_.reserve(2 * size_t(kCount));
    for (int t = 1; t <= kCount; ++t) {
      table_[2 * size_t(t - 1)] = float(1.0 / (1.0 - std::pow(beta1, t)));
      table_[2 * size_t(t - 1) + 1] = float(1.0 / (1.0 - std::pow(beta2, t)));
    }
    beta1_ = beta1;
    beta2_ = beta2;
  }
  return table_.data();
}

}  // namespace gausslite
