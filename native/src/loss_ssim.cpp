// SPDX-License-Identifier: Apache-2.0
// Stage 5b: the SSIM term and its gradient, row by row in cache. Blurring twice (image moments, then partial
// derivatives) over whole planes would pass some thirty images through memory; here a row goes through both blurs while
// the rows above and below it are still in rolling buffers of a few hundred kilobytes.
//
// With the window mean E of the image x and the target y: S = A1 A2 / (B1 B2), A1 = 2 Ex Ey + C1, A2 = 2 (Exy - Ex Ey)
// + C2, B1 = Ex^2 + Ey^2 + C1, B2 = Exx - Ex^2 + Eyy - Ey^2 + C2. The gradient at a pixel is the blur of dS/dEx, plus
// 2x times that of dS/dExx, plus y times that of dS/dExy. Pixels outside the image count as zero.
#include <algorithm>

#include "stage_functions.h"

namespace gausslite::GAUSSLITE_ISA {

namespace {

constexpr float kC1 = 1e-4f, kC2 = 9e-4f;
constexpr int kRadius = 5, kTaps = 2 * kRadius + 1;
// Gaussian of sigma 1.5 px, normalised over its 11 taps; element k is the weight at distance k.
constexpr float kWindow[kRadius + 1] = {0.26601171f, 0.21300553f, 0.10936070f, 0.03600077f, 0.00759876f, 0.00102838f};

constexpr int kRing = 16;  // rows kept of a rolling buffer; a power of two of at least kTaps
constexpr int kMoments =
    3;  // what is blurred at a time: x, xx, xy on the way forward, their derivatives on the way back
constexpr int kMargin = 2;  // packs of zeros left and right of a row

GAUSSLITE_INLINE Pack16 blur_along(const float* p) {
  Pack16 total = load(p) * kWindow[0];
  for (int k = 1; k <= kRadius; ++k) total = fma(load(p - k) + load(p + k), Pack16(kWindow[k]), total);
  return total;
}

GAUSSLITE_INLINE Pack16 blur_across(const float* const (&rows)[kTaps], int at) {
  Pack16 total = load(rows[kRadius] + at) * kWindow[0];
  for (int k = 1; k <= kRadius; ++k)
    total = fma(load(rows[kRadius - k] + at) + load(rows[kRadius + k] + at), Pack16(kWindow[k]), total);
  return total;
}

// Row buffers for the columns [begin, end), multiples of 16. A row has margins, so that index 0 is column `begin`.
class RowBuffers {
 public:
  static size_t floats(int padded_width) { return size_t(kRows) * size_t(padded_width + 2 * kMargin * 16); }

  RowBuffers(float* memory, int begin, int end) : memory_(memory), width_(end - begin) {
    std::fill_n(zero() - kMargin * 16, size_t(width_ + 2 * kMargin * 16), 0.0f);
    for (int k = 0; k < kMoments; ++k) {
      std::fill_n(partial(k) - kMargin * 16, kMargin * 16, 0.0f);
      std::fill_n(partial(k) + width_, kMargin * 16, 0.0f);
    }
  }

  float* zero() { return at(0); }
  float* input(int k) { return at(1 + k); }
  float* partial(int k) { return at(1 + kMoments + k); }
  float* blurred_input(int k, int y) { return at(1 + 2 * kMoments + k * kRing + (y & (kRing - 1))); }
  float* blurred_partial(int k, int y) { return at(1 + (2 + kRing) * kMoments + k * kRing + (y & (kRing - 1))); }

 private:
  static constexpr int kRows = 1 + 2 * kMoments * (1 + kRing);
  float* at(int row) { return memory_ + size_t(row) * size_t(width_ + 2 * kMargin * 16) + kMargin * 16; }

  float* memory_;
  int width_;
};

// Columns with a weight on rows [first, end), widened to multiples of 16; empty when there are none.
struct Columns {
  int begin, end;

  Columns(const Targets& targets, int first, int last) : begin(1 << 20), end(0) {
    for (int y = first; y < last; ++y) {
      const int from = targets.spans[2 * y], to = targets.spans[2 * y + 1];
      if (from == to) continue;
      begin = std::min(begin, from / 16 * 16);
      end = std::max(end, (to + 15) / 16 * 16);
    }
  }
};

// One colour channel of image rows [first, last).
class ChannelPass {
 public:
  ChannelPass(Workspace& ws, const Training& training, int channel, Columns columns, RowBuffers& rows)
      : ws_(ws),
        t_(training.targets),
        scale_(training.loss.ssim),
        sums_(training.loss_sums),
        columns_(columns),
        rows_(rows) {
    image_ = ws.image.data() + channel * ws.plane;
    target_ = t_.rgb + channel * ws.plane;
    gradient_ = ws.image_gradient.data() + channel * ws.plane;
    mean_ = t_.moments + channel * ws.plane;
    square_ = t_.moments + (3 + channel) * ws.plane;
  }

  void run(int first, int last) {
    const int height = ws_.camera.height;
    int next_input = std::max(0, first - 2 * kRadius);
    for (int y = first - kRadius; y < last + kRadius; ++y) {
      bool weighted = y >= 0 && y < height && t_.spans[2 * y] != t_.spans[2 * y + 1];
      if (weighted) {
        next_input = std::max(next_input, y - kRadius);
        for (; next_input <= std::min(y + kRadius, height - 1); ++next_input) blur_input(next_input);
        derive(y, y >= first && y < last);
      }
      has_partial_[y & (kRing - 1)] = weighted;
      const int done = y - kRadius;
      if (done >= first && done < last) add_gradient(done);
    }
  }

 private:
  int64_t offset(int y) const { return int64_t(y) * ws_.padded_width; }
  int width() const { return columns_.end - columns_.begin; }

  // Image or target pixels of one pack, zero outside the image.
  GAUSSLITE_INLINE Pack16 pixels(const float* plane, int y, int x) const {
    if (x < 0 || x >= ws_.camera.width) return Pack16(0.0f);
    const Pack16 values = load(plane + offset(y) + x);
    return x + 16 <= ws_.camera.width ? values : keep(first_lanes(ws_.camera.width - x), values);
  }

  void blur_input(int y) {
    for (int i = -16; i < width() + 16; i += 16) {
      const Pack16 x = pixels(image_, y, columns_.begin + i), t = pixels(target_, y, columns_.begin + i);
      store(rows_.input(0) + i, x);
      store(rows_.input(1) + i, x * x);
      store(rows_.input(2) + i, x * t);
    }
    for (int k = 0; k < kMoments; ++k) {
      const float* in = rows_.input(k);
      float* out = rows_.blurred_input(k, y);
      for (int i = 0; i < width(); i += 16) store(out + i, blur_along(in + i));
    }
  }

  // SSIM of row y, its three derivatives times the weights, and their blur along the row.
  void derive(int y, bool own) {
    const float* window[kMoments][kTaps];
    for (int k = 0; k < kMoments; ++k) {
      for (int tap = 0; tap < kTaps; ++tap) {
        const int from = y + tap - kRadius;
        window[k][tap] = from >= 0 && from < ws_.camera.height ? rows_.blurred_input(k, from) : rows_.zero();
      }
    }
    Pack16 total(0.0f);
    for (int i = 0; i < width(); i += 16) {
      const int64_t at = offset(y) + columns_.begin + i;
      const Pack16 Ex = blur_across(window[0], i), Exx = blur_across(window[1], i), Exy = blur_across(window[2], i);
      const Pack16 Ey = load(mean_ + at), Eyy = load(square_ + at), weight = load(t_.weight + at) * -scale_;
      const Pack16 cross = Ex * Ey, Ex2 = Ex * Ex, Ey2 = Ey * Ey;
      const Pack16 A1 = fma(cross, Pack16(2.0f), Pack16(kC1)), A2 = fma(Exy - cross, Pack16(2.0f), Pack16(kC2));
      const Pack16 B1 = Ex2 + Ey2 + kC1, B2 = (Exx - Ex2) + (Eyy - Ey2) + kC2;
      const Pack16 inverse = Pack16(1.0f) / (B1 * B2), S = A1 * A2 * inverse, scaled = weight * inverse;
      total = fma(S, weight, total);
      const Pack16 by_A1 = A2 * scaled, by_A2 = A1 * scaled, by_B1 = -(S * B2 * scaled), by_B2 = -(S * B1 * scaled);
      const Pack16 by_Ex = fma(Ey, by_A1 - by_A2, Ex * (by_B1 - by_B2));
      store(rows_.partial(0) + i, by_Ex + by_Ex);
      store(rows_.partial(1) + i, by_B2);
      store(rows_.partial(2) + i, by_A2 + by_A2);
    }
    if (own) sums_[y] += double(sum(total));
    for (int k = 0; k < kMoments; ++k) {
      const float* in = rows_.partial(k);
      float* out = rows_.blurred_partial(k, y);
      for (int i = -16; i < width() + 16; i += 16) store(out + i, blur_along(in + i));
    }
  }

  void add_gradient(int y) {
    const float* window[kMoments][kTaps];
    bool anything = false;
    for (int tap = 0; tap < kTaps; ++tap) {
      const int from = y + tap - kRadius;
      const bool present = has_partial_[from & (kRing - 1)];
      anything = anything || present;
      for (int k = 0; k < kMoments; ++k) window[k][tap] = present ? rows_.blurred_partial(k, from) : rows_.zero();
    }
    if (!anything) return;
    for (int i = -16; i < width() + 16; i += 16) {
      const int x = columns_.begin + i;
      if (x < 0 || x >= ws_.padded_width) continue;
      const int64_t at = offset(y) + x;
      const Pack16 by_x = blur_across(window[0], i), by_xx = blur_across(window[1], i),
                   by_xy = blur_across(window[2], i);
      const Pack16 image = load(image_ + at);
      const Pack16 change = by_x + fma(image + image, by_xx, load(target_ + at) * by_xy);
      const int inside = ws_.camera.width - x;
      store(gradient_ + at,
            load(gradient_ + at) + (inside >= 16 ? change : keep(first_lanes(std::max(0, inside)), change)));
    }
  }

  Workspace& ws_;
  const Targets& t_;
  const float scale_;
  double* sums_;
  const Columns columns_;
  RowBuffers& rows_;
  const float *image_, *target_, *mean_, *square_;
  float* gradient_;
  bool has_partial_[kRing] = {};
};

}  // namespace

void loss_ssim(Workspace& ws, const Training& training, int begin, int end, int thread) {
  const Columns columns(training.targets, std::max(0, begin - kRadius), std::min(ws.camera.height, end + kRadius));
  if (columns.begin >= columns.end) return;
  Buffer<float>& memory = ws.scratch[size_t(thread)].ssim;
  memory.reserve(RowBuffers::floats(ws.padded_width));
  RowBuffers rows(memory.data(), columns.begin, columns.end);
  for (int channel = 0; channel < 3; ++channel) ChannelPass(ws, training, channel, columns, rows).run(begin, end);
}

size_t ssim_scratch_floats(int padded_width) { return RowBuffers::floats(padded_width); }

void prepare_ssim(const float* rgb, int width, int height, int padded_width, int64_t plane, float* moments,
                  float* scratch) {
  RowBuffers rows(scratch, 0, padded_width);
  for (int channel = 0; channel < 3; ++channel) {
    int next_input = 0;
    for (int y = 0; y < height; ++y) {
      for (; next_input <= std::min(y + kRadius, height - 1); ++next_input) {
        for (int x = -16; x < padded_width + 16; x += 16) {
          const bool inside = x >= 0 && x < padded_width;
          Pack16 t(0.0f);
          if (inside) t = load(rgb + channel * plane + int64_t(next_input) * padded_width + x);
          if (inside && x + 16 > width) t = keep(first_lanes(std::max(0, width - x)), t);
          store(rows.input(0) + x, t);
          store(rows.input(1) + x, t * t);
        }
        for (int k = 0; k < 2; ++k) {
          for (int x = 0; x < padded_width; x += 16)
            store(rows.blurred_input(k, next_input) + x, blur_along(rows.input(k) + x));
        }
      }
      for (int k = 0; k < 2; ++k) {
        const float* window[kTaps];
        for (int tap = 0; tap < kTaps; ++tap) {
          const int from = y + tap - kRadius;
          window[tap] = from >= 0 && from < height ? rows.blurred_input(k, from) : rows.zero();
        }
        float* out = moments + (3 * k + channel) * plane + int64_t(y) * padded_width;
        for (int x = 0; x < padded_width; x += 16) store(out + x, blur_across(window, x));
      }
    }
  }
}

}  // namespace gausslite::GAUSSLITE_ISA
