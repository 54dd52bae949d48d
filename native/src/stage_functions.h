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
void train_tile_row(Workspace&, const TrainingArguments&, int tile_row, int thread);
void render_to_cache(Workspace&, const TrainingArguments&, TileRowCache&, int tile_row, int thread);
void compute_ssim(Workspace&, const TrainingArguments&, const SsimSquareRow&, int thread);
void backward_from_cache(Workspace&, const TrainingArguments&, const RenderedTileRow&);
void backward_tile_row(Workspace&, int tile_row, int thread);
void update(Workspace&, const UpdateArguments&, int thread);
void gradients(Workspace&, const GradientOutput&, int thread);

}  // namespace gausslite::GAUSSLITE_ISA
