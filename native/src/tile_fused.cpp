// SPDX-License-Identifier: Apache-2.0
// Tiles of a training step: render, loss and backward pass. The backward pass reuses splats, lists and alphas of the
// forward pass (TileRowCache). Without SSIM the loss of a pixel depends on that pixel alone. A tile then goes through
// all three steps at once, with its data in the second-level cache, and no image is written. SSIM needs the image
// around a tile: the forward cache of a tile row waits until the adjacent tile rows are rendered.
#include <algorithm>

#include "block_backward.h"
#include "block_forward.h"
#include "image_tile.h"
#include "loss_l1.h"
#include "ssim_gradient.h"
#include "stage_functions.h"
#include "tile_chunk.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

// Offset of block b in sixteen rows of sixteen pixels.
GAUSSLITE_INLINE int corner_in_tile(int b) { return (b >> 2) * kBlockSide * kTileSide + (b & 3) * kBlockSide; }

struct TileGradient {
  BlockGradient block[kBlocksPerTile];
  uint32_t nonzero_blocks = 0;  // bit mask of the blocks with a non-zero gradient

  GAUSSLITE_INLINE void start(int b, const Pack16 (&gradient)[5], const Pack16 (&image)[5]) {
    // A zero gradient of depth implies a zero gradient of alpha.
    const Pack16 size = (abs(gradient[0]) + abs(gradient[1])) + (abs(gradient[2]) + abs(gradient[3]));
    if (!any(size > Pack16(0.0f))) return;
    nonzero_blocks |= 1u << b;
    block[b].start(gradient, image);
  }
};

int chunk_size(uint32_t count, uint32_t first) { return int(std::min<uint32_t>(kChunk, count - first)); }

// Renders a tile and appends it to the forward cache.
CachedTile render(Workspace& ws, TileRowCache& cache, const TileList& list, const TilePosition& tile,
                  BlockState (&state)[kBlocksPerTile]) {
  CachedTile out{cache.record_count, cache.list_count, cache.alpha_count, 0};
  cache.records.ensure_capacity(out.first_record + list.count, out.first_record);
  cache.lists.ensure_capacity(out.first_list + (list.count + kChunk - 1) / kChunk, out.first_list);
  size_t alpha_count = out.first_alpha;
  uint32_t finished = 0;
  for (uint32_t first = 0; first < list.count && finished != 0xFFFF; first += kChunk) {
    const int n = chunk_size(list.count, first);
    Splat* records = &cache.records[out.first_record + first];
    BlockLists& lists = cache.lists[cache.list_count++];
    load_chunk(ws, list, first, n, records, lists);
    // Prefetched this early, the rows are in a near cache when the backward pass adds to them.
    prefetch_rows(ws, records, n, tile);
    size_t entries = 0;
    for (int b = 0; b < kBlocksPerTile; ++b) entries += lists.count[b];
    cache.alphas.ensure_capacity((alpha_count + entries) * 16, alpha_count * 16);
    float* alphas = cache.alphas.data() + alpha_count * 16;
    for (int b = 0; b < kBlocksPerTile; ++b) {
      if (finished >> b & 1u) {
        lists.count[b] = 0;
        continue;
      }
      lists.count[b] = uint16_t(
          composite<true>(records, lists.entry[b], lists.count[b], tile.pixel_x(b), tile.pixel_y(b), state[b], alphas));
      if (state[b].finished()) finished |= 1u << b;
    }
    alpha_count = size_t(alphas - cache.alphas.data()) / 16;
    out.entries = first + uint32_t(n);
  }
  cache.record_count += out.entries;
  cache.alpha_count = alpha_count;
  return out;
}

void backward_cached_tile(Workspace& ws, const TileRowCache& cache, const CachedTile& cached, const TilePosition& tile,
                          TileGradient& gradient) {
  if (gradient.nonzero_blocks == 0) return;
  ChunkSums sums;
  MomentBatch batch;
  const float* alphas = cache.alphas.data() + cached.first_alpha * 16;
  const BlockLists* lists = cache.lists.data() + cached.first_list;
  for (uint32_t first = 0; first < cached.entries; first += kChunk, ++lists) {
    const Splat* records = &cache.records[cached.first_record + first];
    const int n = chunk_size(cached.entries, first);
    if (first + kChunk < cached.entries)
      prefetch_rows(ws, records + kChunk, chunk_size(cached.entries, first + kChunk), tile);
    sums.clear(n);
    for (int b = 0; b < kBlocksPerTile; ++b) {
      if (gradient.nonzero_blocks >> b & 1u) {
        if (lists->count[b] > 0)
          backward_block<true>(records, lists->entry[b], lists->count[b], tile, b, gradient.block[b], sums, batch,
                               alphas);
      } else {
        alphas += 16 * size_t(lists->count[b]);
      }
    }
    batch.flush(sums.moments);
    add_to_rows(ws, records, n, tile, sums);
  }
}

// Computes the L1 terms of one block and their gradient.
GAUSSLITE_INLINE Pack16 compare(const TrainingArguments& training, size_t t, int b, const Pack16 (&image)[5],
                                Pack16 (&gradient)[5]) {
  const ImageTile& target = training.image.tiles[t];
  const int corner = corner_in_tile(b);
  Pack16 rgb[3];
  for (int k = 0; k < 3; ++k) rgb[k] = colour_block(target, k, corner);
  const Pack16 measured_m = load_block(target.depth_m + corner, kTileSide);
  const Pack16 weight = load_block(training.image.tile_weights(t) + corner, kTileSide);
  return l1_of_pixels(image, rgb, measured_m, weight, training.loss, gradient);
}

void train_tile(Workspace& ws, const TrainingArguments& training, size_t t, const TilePosition& tile,
                ThreadScratch& thread_scratch) {
  BlockState state[kBlocksPerTile];
  thread_scratch.tile_cache.clear();
  const CachedTile cached = render(ws, thread_scratch.tile_cache, thread_scratch.tiles[size_t(tile.x)], tile, state);
  thread_scratch.block_evaluations += thread_scratch.tile_cache.alpha_count;
  TileGradient gradient;
  Pack16 loss(0.0f);
  for (int b = 0; b < kBlocksPerTile; ++b) {
    const BlockState& s = state[b];
    const Pack16 image[5] = {s.r, s.g, s.b, s.depth, s.transmittance};
    Pack16 d_image[5];
    loss = loss + compare(training, t, b, image, d_image);
    gradient.start(b, d_image, image);
  }
  training.l1_sums[t] = double(sum(loss));
  backward_cached_tile(ws, thread_scratch.tile_cache, cached, tile, gradient);
}

bool any_tile(const uint16_t* blocks, int tiles_x) {
  return std::any_of(blocks, blocks + tiles_x, [](uint16_t b) { return b != 0; });
}

}  // namespace

// Includes the loss of inactive tiles, whose pixels are black.
void train_tile_row(Workspace& ws, const TrainingArguments& training, int tile_row, int thread) {
  const size_t first = size_t(tile_row) * size_t(ws.tiles_x);
  std::fill_n(training.l1_sums + first, ws.tiles_x, 0.0);
  if (!any_tile(training.image.weighted_blocks + first, ws.tiles_x)) return;
  ThreadScratch& thread_scratch = ws.scratch[size_t(thread)];
  int count = 0;
  const DepthKey* keys = sort_tile_row(ws, tile_row, thread, count);
  bin_tile_row(ws, tile_row, keys, count, thread_scratch.tiles.data());
  for (int x = 0; x < ws.tiles_x; ++x) {
    const size_t t = first + size_t(x);
    if (training.image.weighted_blocks[t] != 0)
      train_tile(ws, training, t, TilePosition(ws, x, tile_row), thread_scratch);
  }
}

void render_to_cache(Workspace& ws, const TrainingArguments& training, TileRowCache& cache, int tile_row, int thread) {
  const size_t first = size_t(tile_row) * size_t(ws.tiles_x);
  cache.clear();
  if (!any_tile(training.image.reached_blocks + first, ws.tiles_x)) return;
  ThreadScratch& thread_scratch = ws.scratch[size_t(thread)];
  int count = 0;
  const DepthKey* keys = sort_tile_row(ws, tile_row, thread, count);
  bin_tile_row(ws, tile_row, keys, count, thread_scratch.tiles.data());
  cache.tiles.ensure_capacity(size_t(ws.tiles_x));
  cache.image.ensure_capacity(image_offset(ws.tiles_x));
  for (int x = 0; x < ws.tiles_x; ++x) {
    const size_t t = first + size_t(x);
    if (training.image.reached_blocks[t] == 0) continue;
    if (ws.needed_blocks[t] == 0 && training.image.weighted_blocks[t] == 0) {
      // Windows reach this tile, but it is not rendered: its pixels are black.
      cache.tiles[size_t(x)].entries = 0;
      std::fill_n(cache.image.data() + image_offset(x), 3 * kTilePixels, 0.0f);
      continue;
    }
    const TilePosition tile(ws, x, tile_row);
    BlockState state[kBlocksPerTile];
    cache.tiles[size_t(x)] = render(ws, cache, thread_scratch.tiles[size_t(x)], tile, state);
    float* image = cache.image.data() + image_offset(x);
    for (int b = 0; b < kBlocksPerTile; ++b) {
      const Pack16 pixels[kImagePlanes] = {state[b].r, state[b].g, state[b].b, state[b].depth, state[b].transmittance};
      for (int k = 0; k < kImagePlanes; ++k)
        store_block(image + k * kTilePixels + corner_in_tile(b), kTileSide, pixels[k]);
    }
    clear_beyond_edge(ws.camera, x, tile_row, image);
  }
  thread_scratch.block_evaluations += cache.alpha_count;
}

void backward_from_cache(Workspace& ws, const TrainingArguments& training, const RenderedTileRow& tile_row) {
  const TileRowCache& cache = tile_row.cache;
  for (int x = 0; x < ws.tiles_x; ++x) {
    const size_t t = size_t(tile_row.index) * size_t(ws.tiles_x) + size_t(x);
    training.l1_sums[t] = 0.0;
    if (training.image.reached_blocks[t] == 0) continue;
    const CachedTile& rendered = cache.tiles[size_t(x)];
    if (rendered.entries == 0 && training.image.weighted_blocks[t] == 0) continue;
    const TilePosition tile(ws, x, tile_row.index);
    prefetch_rows(ws, cache.records.data() + rendered.first_record, chunk_size(rendered.entries, 0), tile);
    TileColours ssim_gradients;
    const bool reached = ssim_gradient(ws, training.image, tile_row, x, ssim_gradients);
    TileGradient gradient;
    Pack16 loss(0.0f);
    for (int b = 0; b < kBlocksPerTile; ++b) {
      Pack16 image[kImagePlanes], d_image[kImagePlanes];
      for (int k = 0; k < kImagePlanes; ++k)
        image[k] = load_block(cache.image.data() + image_offset(x) + k * kTilePixels + corner_in_tile(b), kTileSide);
      loss = loss + compare(training, t, b, image, d_image);
      for (int k = 0; reached && k < 3; ++k)
        d_image[k] = d_image[k] + load_block(ssim_gradients.value[k] + corner_in_tile(b), kTileSide);
      gradient.start(b, d_image, image);
    }
    training.l1_sums[t] = double(sum(loss));
    backward_cached_tile(ws, cache, rendered, tile, gradient);
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
