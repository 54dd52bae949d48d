// SPDX-License-Identifier: Apache-2.0
// Stages 4 to 6 with a tape: a tile is drawn, compared and walked back without anything being gathered or computed
// twice. Where the loss looks at each pixel alone, a tile goes through all three at once, while its records, lists and
// alphas are in the second-level cache, and no image is written. SSIM needs the image around a tile first: then the
// tape of a whole strip waits until its neighbours are drawn.
#include <algorithm>

#include "block_backward.h"
#include "block_forward.h"
#include "loss_l1.h"
#include "ssim_gradient.h"
#include "stage_functions.h"
#include "target_pixels.h"
#include "tile_chunk.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

// Where block b is in sixteen rows of sixteen pixels.
GAUSSLITE_INLINE int corner_in_tile(int b) { return (b >> 2) * kBlock * kTile + (b & 3) * kBlock; }

struct TileGradient {
  BlockGradient block[kBlocks];
  uint32_t live = 0;  // blocks with a gradient that is not zero

  GAUSSLITE_INLINE void start(int b, const Pack16 (&gradient)[5], const Pack16 (&image)[5]) {
    // The gradient by alpha is zero where that by depth is.
    const Pack16 size = (abs(gradient[0]) + abs(gradient[1])) + (abs(gradient[2]) + abs(gradient[3]));
    if (!any(size > Pack16(0.0f))) return;
    live |= 1u << b;
    block[b].start(gradient, image);
  }
};

int chunk_size(uint32_t count, uint32_t first) { return int(std::min<uint32_t>(kChunk, count - first)); }

// Draws a tile and appends it to the tape.
TileTape draw(Workspace& ws, StripTape& tape, const TileList& list, const TilePosition& tile,
              BlockState (&state)[kBlocks]) {
  TileTape out{tape.record_count, tape.list_count, tape.alpha_count, 0};
  tape.records.reserve(out.first_record + list.count, out.first_record);
  tape.lists.reserve(out.first_list + (list.count + kChunk - 1) / kChunk, out.first_list);
  size_t alpha_count = out.first_alpha;
  uint32_t finished = 0;
  for (uint32_t first = 0; first < list.count && finished != 0xFFFF; first += kChunk) {
    const int n = chunk_size(list.count, first);
    Splat* records = &tape.records[out.first_record + first];
    BlockLists& lists = tape.lists[tape.list_count++];
    load_chunk(ws, list, first, n, records, lists);
    // Early: by the time the way back adds to them, the rows have come from memory to a nearer cache.
    prefetch_rows(ws, records, n, tile);
    size_t entries = 0;
    for (int b = 0; b < kBlocks; ++b) entries += lists.count[b];
    tape.alphas.reserve((alpha_count + entries) * 16, alpha_count * 16);
    float* alphas = tape.alphas.data() + alpha_count * 16;
    for (int b = 0; b < kBlocks; ++b) {
      if (finished >> b & 1u) {
        lists.count[b] = 0;
        continue;
      }
      lists.count[b] = uint16_t(
          composite<true>(records, lists.entry[b], lists.count[b], tile.pixel_x(b), tile.pixel_y(b), state[b], alphas));
      if (state[b].finished()) finished |= 1u << b;
    }
    alpha_count = size_t(alphas - tape.alphas.data()) / 16;
    out.entries = first + uint32_t(n);
  }
  tape.record_count += out.entries;
  tape.alpha_count = alpha_count;
  return out;
}

void walk_back_tile(Workspace& ws, const StripTape& tape, const TileTape& taped, const TilePosition& tile,
                    TileGradient& gradient) {
  if (gradient.live == 0) return;
  ChunkSums sums;
  MomentBatch batch;
  const float* alphas = tape.alphas.data() + taped.first_alpha * 16;
  const BlockLists* lists = tape.lists.data() + taped.first_list;
  for (uint32_t first = 0; first < taped.entries; first += kChunk, ++lists) {
    const Splat* records = &tape.records[taped.first_record + first];
    const int n = chunk_size(taped.entries, first);
    if (first + kChunk < taped.entries)
      prefetch_rows(ws, records + kChunk, chunk_size(taped.entries, first + kChunk), tile);
    sums.clear(n);
    for (int b = 0; b < kBlocks; ++b) {
      if (gradient.live >> b & 1u) {
        if (lists->count[b] > 0)
          walk_back<true>(records, lists->entry[b], lists->count[b], tile, b, gradient.block[b], sums, batch, alphas);
      } else {
        alphas += 16 * size_t(lists->count[b]);
      }
    }
    batch.flush(sums.moments);
    add_to_rows(ws, records, n, tile, sums);
  }
}

// The L1 terms of one block, and their gradient.
GAUSSLITE_INLINE Pack16 compare(const Training& training, size_t t, int b, const Pack16 (&image)[5],
                                Pack16 (&gradient)[5]) {
  const TargetTile& target = training.targets.tiles[t];
  const int corner = corner_in_tile(b);
  Pack16 rgb[3];
  for (int k = 0; k < 3; ++k) rgb[k] = colour_block(target, k, corner);
  const Pack16 measured_m = load_block(target.depth_m + corner, kTile);
  const Pack16 weight = load_block(training.targets.tile_weights(t) + corner, kTile);
  return l1_of_pixels(image, rgb, measured_m, weight, training.loss, gradient);
}

void train_tile(Workspace& ws, const Training& training, size_t t, const TilePosition& tile, ThreadScratch& mine) {
  BlockState state[kBlocks];
  mine.tape.rewind();
  const TileTape taped = draw(ws, mine.tape, mine.tiles[size_t(tile.x)], tile, state);
  mine.block_evaluations += mine.tape.alpha_count;
  TileGradient gradient;
  Pack16 loss(0.0f);
  for (int b = 0; b < kBlocks; ++b) {
    const BlockState& s = state[b];
    const Pack16 image[5] = {s.r, s.g, s.b, s.depth, s.transmittance};
    Pack16 by[5];
    loss = loss + compare(training, t, b, image, by);
    gradient.start(b, by, image);
  }
  training.l1_sums[t] = double(sum(loss));
  walk_back_tile(ws, mine.tape, taped, tile, gradient);
}

bool any_tile(const uint16_t* blocks, int tiles_x) {
  return std::any_of(blocks, blocks + tiles_x, [](uint16_t b) { return b != 0; });
}

}  // namespace

// An inactive tile stays empty, and its pixels count as they are.
void train_strip(Workspace& ws, const Training& training, int strip, int thread) {
  const size_t first = size_t(strip) * size_t(ws.tiles_x);
  std::fill_n(training.l1_sums + first, ws.tiles_x, 0.0);
  if (!any_tile(training.targets.weighted_blocks + first, ws.tiles_x)) return;
  ThreadScratch& mine = ws.scratch[size_t(thread)];
  int count = 0;
  const DepthKey* keys = sort_strip(ws, strip, thread, count);
  bin_strip(ws, strip, keys, count, mine.tiles.data());
  for (int x = 0; x < ws.tiles_x; ++x) {
    const size_t t = first + size_t(x);
    if (training.targets.weighted_blocks[t] != 0) train_tile(ws, training, t, TilePosition(ws, x, strip), mine);
  }
}

void draw_on_tape(Workspace& ws, const Training& training, StripTape& tape, int strip, int thread) {
  const size_t first = size_t(strip) * size_t(ws.tiles_x);
  tape.rewind();
  if (!any_tile(training.targets.reached_blocks + first, ws.tiles_x)) return;
  ThreadScratch& mine = ws.scratch[size_t(thread)];
  int count = 0;
  const DepthKey* keys = sort_strip(ws, strip, thread, count);
  bin_strip(ws, strip, keys, count, mine.tiles.data());
  tape.tiles.reserve(size_t(ws.tiles_x));
  tape.image.reserve(image_tile(ws.tiles_x));
  for (int x = 0; x < ws.tiles_x; ++x) {
    const size_t t = first + size_t(x);
    if (training.targets.reached_blocks[t] == 0) continue;
    if (ws.wanted_blocks[t] == 0 && training.targets.weighted_blocks[t] == 0) {
      // Windows reach into it, but it is not to be drawn: they see black.
      tape.tiles[size_t(x)].entries = 0;
      std::fill_n(tape.image.data() + image_tile(x), 3 * kSquare, 0.0f);
      continue;
    }
    const TilePosition tile(ws, x, strip);
    BlockState state[kBlocks];
    tape.tiles[size_t(x)] = draw(ws, tape, mine.tiles[size_t(x)], tile, state);
    float* image = tape.image.data() + image_tile(x);
    for (int b = 0; b < kBlocks; ++b) {
      const Pack16 pixels[kImagePlanes] = {state[b].r, state[b].g, state[b].b, state[b].depth, state[b].transmittance};
      for (int k = 0; k < kImagePlanes; ++k) store_block(image + k * kSquare + corner_in_tile(b), kTile, pixels[k]);
    }
    clear_beyond_edge(ws.camera, x, strip, image);
  }
  mine.block_evaluations += tape.alpha_count;
}

void walk_back_on_tape(Workspace& ws, const Training& training, const TapedStrip& taped) {
  const StripTape& tape = taped.tape;
  for (int x = 0; x < ws.tiles_x; ++x) {
    const size_t t = size_t(taped.strip) * size_t(ws.tiles_x) + size_t(x);
    training.l1_sums[t] = 0.0;
    if (training.targets.reached_blocks[t] == 0) continue;
    const TileTape& drawn = tape.tiles[size_t(x)];
    if (drawn.entries == 0 && training.targets.weighted_blocks[t] == 0) continue;
    const TilePosition tile(ws, x, taped.strip);
    prefetch_rows(ws, tape.records.data() + drawn.first_record, chunk_size(drawn.entries, 0), tile);
    TileColours by_ssim;
    const bool reached = ssim_gradient(ws, training.targets, taped, x, by_ssim);
    TileGradient gradient;
    Pack16 loss(0.0f);
    for (int b = 0; b < kBlocks; ++b) {
      Pack16 image[kImagePlanes], by[kImagePlanes];
      for (int k = 0; k < kImagePlanes; ++k)
        image[k] = load_block(tape.image.data() + image_tile(x) + k * kSquare + corner_in_tile(b), kTile);
      loss = loss + compare(training, t, b, image, by);
      for (int k = 0; reached && k < 3; ++k) by[k] = by[k] + load_block(by_ssim.value[k] + corner_in_tile(b), kTile);
      gradient.start(b, by, image);
    }
    training.l1_sums[t] = double(sum(loss));
    walk_back_tile(ws, tape, drawn, tile, gradient);
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
