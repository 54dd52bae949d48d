// SPDX-License-Identifier: Apache-2.0
// The stage table of this instruction set, for dispatch.cpp.
#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

const Stages& stages() {
  static constexpr Stages kStages{project,           render_tile_row, train_tile_row,
                                  render_to_cache,   compute_ssim,    backward_from_cache,
                                  backward_tile_row, update,          gradients};
  return kStages;
}

}  // namespace gausslite::GAUSSLITE_ISA
