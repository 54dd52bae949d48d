// SPDX-License-Identifier: Apache-2.0
// The data of a frame that stages pass on to each other; independent of the instruction set. stages.h defines the
// terms.
#pragma once

#include <atomic>
#include <cstdint>
#include <cstring>
#include <vector>

#include "active_tiles.h"
#include "camera.h"
#include "memory.h"

namespace gausslite {

// A projected splat in one cache line. With (dx, dy) = pixel - mean, log2(alpha) at a pixel is
// log2_opacity - (quad_xx·dx² + quad_xy·dx·dy + quad_yy·dy²).
struct alignas(64) Splat {
  float mean_x, mean_y;
  float quad_xx, quad_xy, quad_yy;
  float log2_opacity;
  float r, g, b, depth;
  float slope_y;           // the dy that minimises the quadric at dx = 1, and
  float slope_x;           // the dx at dy = 1, for the overlap test of ellipse and block
  float tile_x0, tile_x1;  // integers: first and last tile column of the bounding box
  // Its first gradient row minus its first tile row. Its gradients in tile row y are in row
  // gradient_row_minus_tile_y + y (modulo 2^32).
  uint32_t gradient_row_minus_tile_y;
};
static_assert(sizeof(Splat) == 64);

// Data of a visible splat for the projection's backward pass.
struct VisibleSplat {
  uint32_t id;            // parameter row
  uint32_t gradient_row;  // first of its image gradient rows, one per tile row of its bounding box
  uint32_t gradient_rows;
};

struct DepthKey {
  uint32_t depth, slot;  // bits of the positive float depth; index into Workspace::splats
};

// Aligned, like ThreadScratch, so that the counters of two threads share no cache line.
struct alignas(64) KeyList {
  Buffer<DepthKey> keys;
  uint32_t count = 0;
};

// The splats of a tile, nearest first, and the 4x4 blocks that each one overlaps (bit 4 row + column).
struct TileList {
  Buffer<uint32_t> slots;
  Buffer<uint16_t> blocks;
  uint32_t count = 0;
  uint32_t
      used[kBlocksPerTile];  // composited entries of each block's list: all, or those before its pixels were finished
};

// The SSIM loss is computed in squares of the size of a tile. They lie half a tile higher than the tiles: SSIM square x
// of row k spans image rows 16 k - 8 ... 16 k + 7 and the columns of tile column x (loss_ssim.cpp).
constexpr int kTilePixels = kTileSide * kTileSide;  // of a tile, and of an SSIM square
constexpr int kSsimMaps = 3;        // blurred maps of SSIM: x, xx, xy forward, their derivatives backward
constexpr int kChunk = 128;         // splats of a tile per batch: their records fit the first-level cache
constexpr int kPrefetchAhead = 64;  // number of depth keys between a prefetch and the use of its splat
constexpr int kSegmentRows = 2048;  // parameter rows per segment, the unit of projection and update work

// Means of sixteen parameter rows, and the largest log scale of each: they bound the splats' extent in the image.
struct alignas(64) GroupBounds {
  float mean[3][16], log_scale[16];
};

// Range of a segment's keys in its thread's list of a tile row.
struct KeySpan {
  uint32_t begin, end;
};

// For each block, the entries of a chunk that overlap it, in order. Lists are padded for whole-register writes.
struct BlockLists {
  alignas(64) uint8_t entry[kBlocksPerTile][kChunk + 32];
  uint16_t count[kBlocksPerTile];

  // Sets the counts and pads each list with entry 0, for loops that read ahead.
  __attribute__((always_inline)) void end(const uint32_t (&counts)[kBlocksPerTile]) {
    for (int b = 0; b < kBlocksPerTile; ++b) {
      count[b] = uint16_t(counts[b]);
      std::memset(entry[b] + counts[b], 0, 4);
    }
  }
};

// Position of a rendered tile in the forward cache of its tile row.
struct CachedTile {
  size_t first_record, first_list, first_alpha;
  uint32_t entries;  // entries of its list that were rendered before all pixels were finished
};

// The forward cache of a tile row: values of its forward pass for its backward pass. These are the splats, block lists
// and alphas of its tiles in rendering order. The alphas take 64 bytes per overlap of a splat and a block, some
// megabytes per tile row. Reading them from the third-level cache is faster than computing them again.
struct TileRowCache {
  Buffer<CachedTile> tiles;
  Buffer<Splat> records;
  Buffer<BlockLists> lists;
  Buffer<float> alphas;
  Buffer<float> image;  // [tile][red, green, blue, depth, transmittance][16][16]
  size_t record_count = 0, list_count = 0, alpha_count = 0;

  void clear() { record_count = list_count = alpha_count = 0; }
};

// Offset of tile column x in TileRowCache::image.
constexpr int kImagePlanes = 5;
inline size_t image_offset(int x) { return size_t(x) * kImagePlanes * kTilePixels; }

// Offset of a map of SSIM square x in its row of squares: sixteen rows of sixteen floats.
inline size_t ssim_map_offset(int x, int channel, int map) {
  return size_t((x * 3 + channel) * kSsimMaps + map) * kTilePixels;
}

struct alignas(64) ThreadScratch {
  std::vector<KeyList> tile_rows;  // by tile row: keys of this thread's segments
  Buffer<DepthKey> sorted[2];
  std::vector<TileList> tiles;                           // of the current tile row of a training step
  TileRowCache tile_cache;                               // forward cache of one tile, for steps without SSIM
  Buffer<float> ssim;                                    // columns of the SSIM loss
  uint32_t next_gradient_row = 0, end_gradient_row = 0;  // rows that this thread has reserved and not used
  uint64_t block_evaluations = 0;                        // composited entries of block lists in this frame
  alignas(64) std::atomic<uint32_t> segments_taken{0};   // number of this thread's segments that are taken
};

struct Workspace {
  Camera camera;
  int tiles_x = 0, tiles_y = 0, padded_width = 0;
  int64_t plane_pixels = 0;  // pixels of the image, padded to whole tiles: floats in one plane of it
  int threads = 1;

  // Input of the frame. `count` entries: rows `ids[0..count)`, or rows 0..count if ids is null. The backward pass reads
  // `rows` again: the caller must not free or change them before.
  const float* rows = nullptr;
  const uint32_t* ids = nullptr;
  uint32_t count = 0;
  const uint8_t* active_tiles = nullptr;  // null: all
  ActiveTiles active;                     // lookup tables of the last frame with active_tiles

  // Projection. A segment's visible splats are at its front: slots segment * kSegmentRows + 0 .. segment_visible.
  Buffer<Splat> splats;
  Buffer<VisibleSplat> visible;
  Buffer<uint32_t> segment_visible;
  Buffer<uint32_t> segment_thread;  // thread that projected it
  Buffer<KeySpan> segment_keys;     // [segment][tile row]
  uint32_t segments = 0;
  // Culling bounds of the rows of bound tables, kept from step to step. A step then reads 16 bytes per row to find the
  // candidates, not 64. The first projection of all rows computes the bounds; the update keeps them current.
  Buffer<GroupBounds> bounds;  // of rows 16 k ... 16 k + 15
  bool stores_bounds = false, has_bounds = false;

  // Raster. Lists contain needed blocks only: those of active tiles that the loss depends on.
  Buffer<uint16_t> needed_blocks;
  // image: red, green, blue, depth, transmittance; image_gradient: by red, green, blue, depth, alpha.
  std::vector<TileList> tiles;  // of the last forward, for its backward pass
  Buffer<float> image, image_gradient;
  // A training step with SSIM reuses a few of these, so that they stay in cache.
  std::vector<TileRowCache> caches;         // of tile rows between forward and backward pass
  std::vector<Buffer<float>> ssim_squares;  // rows of SSIM squares: derivatives, blurred along the image rows
  // Each gradient row belongs to one pair of splat and tile row. So no two threads add to the same row, and the sum
  // over a splat's rows has a fixed order: results do not depend on the number of threads. Each row has the number of
  // the pass that wrote it; rows of other passes than `gradient_pass` count as zero and are never cleared.
  Buffer<float> gradient_rows;
  std::atomic<uint32_t> gradient_rows_used{0};
  uint32_t gradient_pass = 0;

  std::vector<ThreadScratch> scratch;
  // Position in the order of tile rows: threads take the next one. Reset between stages.
  alignas(64) std::atomic<int> next_tile_row{0};

  void reset_segments() {
    for (ThreadScratch& s : scratch) s.segments_taken.store(0, std::memory_order_relaxed);
  }
  // Returns the next segment for this thread, or `segments`. A thread takes its own segments first, the same in every
  // stage and step: their rows, moments and splats are in its caches. Then it takes those of other threads.
  __attribute__((always_inline)) uint32_t take_segment(int thread) {
    const uint32_t count = uint32_t(threads);
    for (uint32_t i = 0; i < count; ++i) {
      const uint32_t owner = (uint32_t(thread) + i) % count;
      const uint32_t taken = scratch[owner].segments_taken.fetch_add(1, std::memory_order_relaxed);
      if (taken * count + owner < segments) return taken * count + owner;
    }
    return segments;
  }
};

}  // namespace gausslite
