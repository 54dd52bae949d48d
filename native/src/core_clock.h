// SPDX-License-Identifier: Apache-2.0
// The clock of the core, for figures in cycles: the time stamp counter runs at a rate of its own.
#pragma once

namespace gausslite {

// GHz of the core that calls, busy as it is now: about a millisecond of work.
double core_clock_ghz();

}  // namespace gausslite
