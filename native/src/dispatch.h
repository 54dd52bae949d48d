// SPDX-License-Identifier: Apache-2.0
// Selects a SIMD variant: one that this build contains and this machine runs.
#pragma once

#include <string>
#include <vector>

#include "stages.h"

namespace gausslite {

// Names of the usable variants, fastest first; the last is `portable`.
std::vector<std::string> usable_variants();

// The stages of a variant, or null if this build lacks it or this machine cannot run it.
const Stages* find_stages(const std::string& variant);

}  // namespace gausslite
