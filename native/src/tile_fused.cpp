// SPDX-License-Identifier: Apache-2.0
// Stages 4 to 6 in one pass, for losses that look at each pixel alone: a tile is drawn, compared and walked back while
// its records, lists and alphas are in the second-level cache. Nothing is gathered or computed twice, and no image is
// written.
#include <algorithm>

#include "block_backward.h"
#include "block_forward.h"
#include "loss_l1.h"
#include "stage_functions.h"
#include "tile_chunk.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

class FusedTile {
 public:
  FusedTile(Workspace& ws, ThreadScratch& mine, const TileList& list, const TilePosition& tile)
      : ws_(ws), mine_(mine), list_(list), tile_(tile) {
    const size_t chunks = (list.count + kChunk - 1) / kChunk;
    mine.records.reserve(chunks * kChunk);
    mine.lists.reserve(chunks);
  }

  void draw() {
    size_t kept = 0;
    uint32_t finished = 0;
    for (uint32_t first = 0; first < list_.count && finished != 0xFFFF; first += kChunk, ++chunks_) {
      Splat* records = &mine_.records[first];
      BlockLists& lists = mine_.lists[size_t(chunks_)];
      load_chunk(ws_, list_, first, chunk_size(chunks_), records, lists);
      // Early: by the time the way back adds to them, the rows have come from memory to the second-level cache.
      prefetch_rows(ws_, records, chunk_size(chunks_), tile_);
      size_t entries = 0;
      for (int b = 0; b < kBlocks; ++b) entries += lists.count[b];
      mine_.alphas.reserve((kept + entries) * 16, kept * 16);
      float* alphas = mine_.alphas.data() + kept * 16;
      for (int b = 0; b < kBlocks; ++b) {
        if (finished >> b & 1u) {
          lists.count[b] = 0;
          continue;
        }
        lists.count[b] = uint16_t(composite<true>(records, lists.entry[b], lists.count[b], tile_.pixel_x(b),
                                                  tile_.pixel_y(b), state_[b], alphas));
        if (state_[b].finished()) finished |= 1u << b;
      }
      kept = size_t(alphas - mine_.alphas.data()) / 16;
    }
    mine_.block_evaluations += kept;
  }

  double compare(const Training& training) {
    Pack16 loss(0.0f);
    const Targets& t = training.targets;
    for (int b = 0; b < kBlocks; ++b) {
      const int64_t at = tile_.block(ws_, b);
      const BlockState& s = state_[b];
      const Pack16 image[5] = {s.r, s.g, s.b, s.depth, s.transmittance};
      Pack16 rgb[3], gradient[5];
      for (int k = 0; k < 3; ++k) rgb[k] = load_block(t.rgb + k * ws_.plane + at, ws_.padded_width);
      const Pack16 measured_m = load_block(t.depth_m + at, ws_.padded_width),
                   weight = load_block(t.weight + at, ws_.padded_width);
      loss = loss + l1_of_pixels(image, rgb, measured_m, weight, training.loss, gradient);
      gradients_[b].start(gradient, image);
    }
    return double(sum(loss));
  }

  void walk_back_all() {
    const float* alphas = mine_.alphas.data();
    for (int c = 0; c < chunks_; ++c) {
      const Splat* records = &mine_.records[size_t(c) * kChunk];
      const BlockLists& lists = mine_.lists[size_t(c)];
      const int n = chunk_size(c);
      sums_.clear(n);
      for (int b = 0; b < kBlocks; ++b) {
        if (lists.count[b] > 0)
          walk_back<true>(records, lists.entry[b], lists.count[b], tile_, b, gradients_[b], sums_, batch_, alphas);
      }
      batch_.flush(sums_.moments);
      add_to_rows(ws_, records, n, tile_, sums_);
    }
  }

 private:
  int chunk_size(int chunk) const { return int(std::min<uint32_t>(kChunk, list_.count - uint32_t(chunk) * kChunk)); }

  Workspace& ws_;
  ThreadScratch& mine_;
  const TileList& list_;
  const TilePosition tile_;
  int chunks_ = 0;  // chunks that were drawn before all pixels were finished
  BlockState state_[kBlocks];
  BlockGradient gradients_[kBlocks];
  ChunkSums sums_;
  MomentBatch batch_;
};

}  // namespace

void train_strip(Workspace& ws, const Training& training, int strip, int thread) {
  int count = 0;
  const DepthKey* keys = sort_strip(ws, strip, thread, count);
  bin_strip(ws, strip, keys, count);
  for (int x = 0; x < ws.tiles_x; ++x) {
    const size_t t = size_t(strip) * size_t(ws.tiles_x) + size_t(x);
    training.loss_sums[t] = 0.0;
    if (!training.targets.weighted_tiles[t]) continue;
    // An inactive tile stays empty, and its pixels count as they are.
    FusedTile tile(ws, ws.scratch[size_t(thread)], ws.tiles[t], TilePosition(ws, x, strip));
    if (ws.active_tiles == nullptr || ws.active_tiles[t]) tile.draw();
    training.loss_sums[t] = tile.compare(training);
    tile.walk_back_all();
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
