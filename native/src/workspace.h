// SPDX-License-Identifier: Apache-2.0
// The scratch memory that one frame's stages hand to each other. It knows nothing of instruction sets.
#pragma once

#include <atomic>
#include <cstdint>
#include <cstring>
#include <vector>

#include "active_tiles.h"
#include "camera.h"
#include "memory.h"

namespace gausslite {

// A projected splat in one cache line. log2(alpha) at a pixel d = pixel - mean is
// log2_opacity - (quad_xx dx dx + quad_xy dx dy + quad_yy dy dy).
struct alignas(64) Splat {
  float mean_x, mean_y;
  float quad_xx, quad_xy, quad_yy;
  float log2_opacity;
  float r, g, b, depth;
  float slope_y;           // the dy that minimises the quadric for dx = 1 ...
  float slope_x;           // ... and the dx for dy = 1: the ellipse-block test needs them
  float tile_x0, tile_x1;  // whole: columns of the first and the last tile that its bounding box touches
  uint32_t gradient_row;   // its image gradients of tile row y are in row gradient_row + y (modulo 2^32)
};
static_assert(sizeof(Splat) == 64);

// What the projection's backward pass needs to know of a visible splat.
struct Visible {
  uint32_t id;            // its parameter row
  uint32_t gradient_row;  // the first of its image gradient rows, one per tile row that it touches
  uint32_t gradient_rows;
};

struct DepthKey {
  uint32_t depth, slot;  // bits of the positive float depth; index into Workspace::splats
};

// Aligned, as ThreadScratch is, so that what one thread counts is in no cache line of another's.
struct alignas(64) KeyList {
  Buffer<DepthKey> keys;
  uint32_t count = 0;
};

// The splats of a tile, nearest first, and the 4x4 blocks that each one touches (bit 4 row + column).
struct TileList {
  Buffer<uint32_t> slots;
  Buffer<uint16_t> blocks;
  uint32_t count = 0;
  uint32_t used[kBlocks];  // entries of each block's list that were composited before all of its pixels were finished
};

constexpr int kSquare = kTile * kTile;
constexpr int kSsimMaps = 3;  // what SSIM blurs: x, xx, xy on the way forward, their derivatives on the way back
constexpr int kChunk = 128;  // splats of a tile that are handled at a time: their records stay in the first-level cache
constexpr int kPrefetchAhead = 64;  // keys
constexpr int kSegment = 2048;  // parameter rows that are projected as a unit, by their own thread unless it is late

// Where the splats of sixteen rows are and how far they may reach: their means, and the largest of their log scales.
struct alignas(64) GroupBounds {
  float mean[3][16], log_scale[16];
};

// A segment's keys in its thread's list of a tile row.
struct KeySpan {
  uint32_t begin, end;
};

// The entries of a chunk that touch each block, in order. Rows have slack for whole-register writes.
struct BlockLists {
  alignas(64) uint8_t entry[kBlocks][kChunk + 32];
  uint16_t count[kBlocks];

  // Once all are listed. Behind its end each list names entry 0 a few times, for loops that look ahead.
  __attribute__((always_inline)) void end(const uint32_t (&counts)[kBlocks]) {
    for (int b = 0; b < kBlocks; ++b) {
      count[b] = uint16_t(counts[b]);
      std::memset(entry[b] + counts[b], 0, 4);
    }
  }
};

// What a drawn tile leaves for its way back.
struct TileTape {
  size_t first_record, first_list, first_alpha;
  uint32_t entries;  // of its list, drawn before all pixels were finished
};

// A strip between its two directions: its tiles' splats, block lists and alphas, in the order in which they are walked.
// An alpha pack is 64 bytes for each block that a splat touches, some megabytes a strip: it lives in the third-level
// cache, and is read back faster than it would be computed again.
struct StripTape {
  Buffer<TileTape> tiles;
  Buffer<Splat> records;
  Buffer<BlockLists> lists;
  Buffer<float> alphas;
  Buffer<float> image;  // [tile][red, green, blue, depth, transmittance][16][16]
  size_t record_count = 0, list_count = 0, alpha_count = 0;

  void rewind() { record_count = list_count = alpha_count = 0; }
};

// Where StripTape::image has a tile.
constexpr int kImagePlanes = 5;
inline size_t image_tile(int x) { return size_t(x) * kImagePlanes * kSquare; }

// Where a row of SSIM squares (loss_ssim.cpp) has a map: sixteen rows of sixteen floats.
inline size_t ssim_square(int x, int channel, int map) { return size_t((x * 3 + channel) * kSsimMaps + map) * kSquare; }

struct alignas(64) ThreadScratch {
  std::vector<KeyList> strips;  // by tile row: the splats of this thread's segments that touch it
  Buffer<DepthKey> sorted[2];
  std::vector<TileList> tiles;                          // of the strip that it trains on
  StripTape tape;                                       // of one tile, where a loss looks at each pixel alone
  Buffer<float> ssim;                                   // columns of the SSIM loss
  uint32_t next_row = 0, last_row = 0;                  // the block of gradient rows this thread is handing out
  uint64_t block_evaluations = 0;                       // block list entries that it composited in this frame
  alignas(64) std::atomic<uint32_t> segments_taken{0};  // of its own
};

struct Workspace {
  Camera camera;
  int tiles_x = 0, tiles_y = 0, padded_width = 0;
  int64_t plane = 0;  // floats in one padded image plane
  int threads = 1;

  // Input of the frame. `count` entries: rows `ids[0..count)`, or rows 0..count when ids is null. Of these the way back
  // reads the rows alone: whoever asks for it keeps them.
  const float* rows = nullptr;
  const uint32_t* ids = nullptr;
  uint32_t count = 0;
  const uint8_t* active_tiles = nullptr;  // null: all
  ActiveTiles active;                     // where they are; of the last frame that named some

  // Projection. A segment's visible splats are packed to its front: slots segment * kSegment + 0 .. segment_visible.
  Buffer<Splat> splats;
  Buffer<Visible> visible;
  Buffer<uint32_t> segment_visible;
  Buffer<uint32_t> segment_thread;  // who projected it
  Buffer<KeySpan> segment_keys;     // [segment][tile row]
  uint32_t segments = 0;
  // While rows change by training steps alone, their bounds are kept from step to step: a step that looks for the rows
  // in sight then reads 16 bytes of each instead of 64. Where they are kept and not known yet, projection notes them.
  Buffer<GroupBounds> bounds;  // of rows 16 k ... 16 k + 15
  bool keeps_bounds = false, knows_bounds = false;

  // Raster. Lists hold the wanted blocks of a tile only: those of the active tiles that the loss depends on.
  Buffer<uint16_t> wanted_blocks;
  // image: red, green, blue, depth, transmittance; image_gradient: by red, green, blue, depth, alpha.
  std::vector<TileList> tiles;  // of the image that was drawn last, for its way back
  Buffer<float> image, image_gradient;
  // A training step with SSIM reuses few of these, so that they stay in cache.
  std::vector<StripTape> tapes;             // strips that are drawn and not yet walked back
  std::vector<Buffer<float>> ssim_squares;  // a row of them each: derivatives of SSIM, blurred along the image rows
  // Gradient rows are owned by one (splat, tile row) pair each, so that no two threads add to the same one and the sum
  // over a splat's rows has a fixed order: results do not depend on the number of threads. `tag` marks the rows written
  // in this pass; stale ones count as zero and are never cleared.
  Buffer<float> gradient_rows;
  std::atomic<uint32_t> gradient_rows_used{0};
  uint32_t tag = 0;

  std::vector<ThreadScratch> scratch;
  // Dynamic scheduling of tile rows and of segments; reset between stages.
  alignas(64) std::atomic<int> ticket{0};

  void hand_out_segments() {
    for (ThreadScratch& s : scratch) s.segments_taken.store(0, std::memory_order_relaxed);
  }
  // The next segment for this thread, or `segments`. A thread's own come first: the same ones in every stage and step,
  // whose rows, moments and splats it has in its caches. Then it helps the others.
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
