// SPDX-License-Identifier: Apache-2.0
// Declarations of the stage functions of the instruction set being compiled; stages.h explains them.
#pragma once

#include "simd/pack.h"
#include "stages.h"

namespace gausslite::GAUSSLITE_ISA {

void project(Workspace&, int thread);
// The depth keys of a tile row, nearest first, with kPrefetchAhead copies of the last behind them.
const DepthKey* sort_strip(Workspace&, int strip, int thread, int& count);
// `tiles`: the lists of the strip's tiles, to be filled.
void bin_strip(const Workspace&, int strip, const DepthKey* keys, int count, TileList* tiles);
void draw_strip(Workspace&, int strip, int thread);
void train_strip(Workspace&, const Training&, int strip, int thread);
void draw_on_tape(Workspace&, const Training&, StripTape&, int strip, int thread);
void derive_ssim(Workspace&, const Training&, const SquareRow&, int thread);
void walk_back_on_tape(Workspace&, const Training&, const TapedStrip&);
void backward_strip(Workspace&, int strip, int thread);
void update(Workspace&, const Update&, int thread);
void gradients(Workspace&, const GradientOutput&, int thread);

}  // namespace gausslite::GAUSSLITE_ISA
