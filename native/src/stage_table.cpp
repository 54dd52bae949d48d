// SPDX-License-Identifier: Apache-2.0
// The stages of the instruction set being compiled, for the dispatcher.
#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

const Stages& stages() {
  static constexpr Stages kStages{project,           draw_strip,     train_strip, draw_on_tape, derive_ssim,
                                  walk_back_on_tape, backward_strip, update,      gradients};
  return kStages;
}

}  // namespace gausslite::GAUSSLITE_ISA
