// SPDX-License-Identifier: Apache-2.0
// Declarations of the stage functions of this instruction set; stages.h documents them.
#pragma once

#include "simd/pack.h"
#include "stages.h"

namespace gausslite::GAUSSLITE_ISA {

void project(Workspace&, int thread);
// Returns the depth keys of a tile row, nearest first, followed by kPrefetchAhead copies of the last.
const DepthKey* sort_tile_row(Workspace&, int tile_row, int thread, int& count);
// `tiles`: the lists of the tile row's tiles, output.
void bin_tile_row(const Workspace&, int tile_row, const DepthKey* keys, int count, TileList* tiles);
void render_tile_row(Workspace&, int tile_row, int thread);
void train_tile_row(Workspace&, const Training&, int tile_row, int thread);
void render_to_replay(Workspace&, const Training&, TileRowReplay&, int tile_row, int thread);
void derive_ssim(Workspace&, const Training&, const SquareRow&, int thread);
void backward_from_replay(Workspace&, const Training&, const ReplayedTileRow&);
void backward_tile_row(Workspace&, int tile_row, int thread);
void update(Workspace&, const Update&, int thread);
void gradients(Workspace&, const GradientOutput&, int thread);

}  // namespace gausslite::GAUSSLITE_ISA
