// SPDX-License-Identifier: Apache-2.0
// Which instruction sets this build has and this machine runs.
#pragma once

#include <string>
#include <vector>

#include "stages.h"

namespace gausslite {

// Names of the usable forms, fastest first; `portable` is always the last.
std::vector<std::string> usable_forms();

// The stages of a form, or null when it is unknown or this machine cannot run it.
const Stages* find_stages(const std::string& form);

}  // namespace gausslite
