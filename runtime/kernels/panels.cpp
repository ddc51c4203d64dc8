// Draw the panels' pictures on the processor (runtime/panels/processor.py): sample a layer, which may be coarse and
// displaced by the content's relief, mix it with the flat picture and apply the panel's grey curve.
#include <pthread.h>
#include <sched.h>

#include <vector>

#include "panels.hpp"

namespace {

constexpr int FRACTION = 7;      // fractional bits of values while pictures are interpolated and mixed
constexpr int UNIT = 1 << 15;    // a pixel, and an interpolation weight of 1, in fixed point
constexpr int BLOCK_PX = 64;     // columns drawn together; where the relief is zero, a block is cheaper
constexpr int MAX_THREADS = 16;

typedef uint16_t Pair __attribute__((may_alias));  // two of a pixel's bytes
typedef uint32_t Word __attribute__((may_alias));  // both of a pixel's pairs

struct alignas(2 * LANES) Block {
  Pair right[2 * BLOCK_PX], down[2 * BLOCK_PX];  // for each pair, weights of the neighbours to the right and below
  int32_t offset[BLOCK_PX];                      // bytes from the source's first pixel to the top left neighbour
  Pair inside[2 * BLOCK_PX];                     // for each pair of a registered panel, 0 outside the panel, or 0xFFFF
  Pair near[4][2 * BLOCK_PX];                    // neighbours: top left, top right, bottom left and bottom right
  int16_t even[2 * BLOCK_PX], odd[2 * BLOCK_PX];  // result: values of each pair's first and second byte
};

INLINE uint32_t twice(int32_t weight) { return uint32_t(weight) << 16 | uint32_t(weight); }
INLINE int16_t even_of(uint16_t pair) { return int16_t((pair << FRACTION) & (255 << FRACTION)); }
INLINE int16_t odd_of(uint16_t pair) { return int16_t((pair >> (8 - FRACTION)) & (255 << FRACTION)); }
INLINE uint16_t pair_of(int16_t even, int16_t odd) {
  constexpr int half_code = 1 << (FRACTION - 1);
  return uint16_t((uint16_t(even + half_code) >> FRACTION) | ((uint16_t(odd + half_code) << (8 - FRACTION)) & 0xFF00));
}
INLINE int16_t between(int16_t a, int16_t b, int16_t weight) { return int16_t(a + product(int16_t(b - a), weight)); }

// Return a position in fixed point, moved into a picture of `count` pixels so that a further pixel follows it. The lower
// 15 bits are the weight of that pixel.
INLINE int32_t fixed(float position, int count) {
  const int32_t at = int32_t(std::min(std::max(position, 0.0f), float(count - 1)) * UNIT);
  return std::max(std::min(at, (count - 1) * UNIT - 1), 0);
}

// The relief near a row of the screen, kept while a thread draws a picture from top to bottom.
struct Relief {
  std::vector<int32_t> first;    // for each column, the last relief pixel before it
  std::vector<float> right;      // weight of the next one
  std::vector<float> lines[2];   // two rows of the relief, resampled to the screen's columns
  std::vector<uint8_t> rises[2];  // for each of their blocks, whether any relief is not zero
  int number[2];                  // numbers of these rows
};

// Memory for a thread, which allocates none itself: it could not report that there is none.
struct Memory {
  Relief kept;
  std::vector<uint32_t> lines[2], between_lines;

  void reserve(size_t columns) {
    kept.first.reserve(columns), kept.right.reserve(columns), between_lines.reserve(columns);
    for (int k = 0; k < 2; ++k) kept.lines[k].reserve(columns), kept.rises[k].reserve(columns), lines[k].reserve(columns);
  }
};

INLINE void prepare(const Shown &shown, Relief &kept) {
  const ScaleShift &to = shown.relief_from_screen;
  kept.first.resize(shown.columns), kept.right.resize(shown.columns);
  const int last = shown.relief_columns - 1;
  for (int c = 0; c < shown.columns; ++c) {
    const float u = std::clamp((float(c) + 0.5f) * to.scale_u + to.shift_u, 0.0f, float(last));
    kept.first[c] = std::min(int(u), std::max(last - 1, 0));
    kept.right[c] = u - float(kept.first[c]);
  }
  for (int k = 0; k < 2; ++k) kept.lines[k].resize(shown.columns), kept.rises[k].resize(shown.columns / BLOCK_PX + 1), kept.number[k] = -1;
}

// Return a row of the relief, resampled to the screen's columns.
INLINE const float *relief_row(const Shown &shown, Relief &kept, int row) {
  float *relief = kept.lines[row & 1].data();
  if (kept.number[row & 1] == row) return relief;
  kept.number[row & 1] = row;
  const float *line = shown.relief + int64_t(row) * shown.relief_columns, *next = line + (shown.relief_columns > 1);
  const int32_t *first = kept.first.data();
  const float *right = kept.right.data();
  VECTORISED for (int c = 0; c < shown.columns; ++c)
    relief[c] = line[first[c]] + (next[first[c]] - line[first[c]]) * right[c];
  for (int from = 0; from < shown.columns; from += BLOCK_PX) {
    float most = 0;
    for (int c = from; c < std::min(from + BLOCK_PX, shown.columns); ++c) most = std::max(most, std::abs(relief[c]));
    kept.rises[row & 1][from / BLOCK_PX] = most > 0;
  }
  return relief;
}

INLINE uint32_t rotated(uint32_t word) { return word << 16 | word >> 16; }

// Copy a row whose pixels coincide with the source's. Return false if the row must be drawn instead.
INLINE bool copied(const Shown &shown, int r) {
  const ScaleShift &at = shown.source_from_panel;
  const float u = 0.5f + at.shift_u, v = float(r) + 0.5f + at.shift_v;
  if (shown.registered || shown.relief || shown.flat || shown.curve || at.scale_u != 1 || at.scale_v != 1) return false;
  if (u != std::floor(u) || v != std::floor(v) || u < 0 || v < 0) return false;
  if (int(u) + shown.columns > shown.source_columns || int(v) >= shown.source_rows) return false;
  const auto *from = reinterpret_cast<const Word *>(shown.source + int64_t(v) * shown.source_stride + int64_t(u) * 4);
  auto *pixels = reinterpret_cast<Word *>(shown.screen + r * shown.screen_stride);
  VECTORISED for (int c = 0; c < shown.columns; ++c)
    pixels[c] = (from[c] & 0xFF00FF00u) | (rotated(from[c]) & 0x00FF00FFu);
  return true;
}

// Find the neighbours and weights of a block's pixels. Unless `upper` is null, they are displaced by the relief between
// two of its rows.
INLINE void locate(const Shown &shown, int r, int begin, int count, const float *upper, const float *lower, float share, Block &block) {
  const ScaleShift at = shown.source_from_panel, push = shown.push;
  const int32_t stride = int32_t(shown.source_stride), rows = shown.source_rows, columns = shown.source_columns;
  const float v = (float(r) + 0.5f) * at.scale_v + at.shift_v, push_v = (float(r) + 0.5f) * push.scale_v + push.shift_v;
  auto *right = reinterpret_cast<Word *>(block.right), *down = reinterpret_cast<Word *>(block.down);
  if (!upper) {
    const int32_t y = fixed(v, rows), from = y / UNIT * stride;
    const uint32_t below = twice(y % UNIT);
    VECTORISED for (int k = 0; k < count; ++k) {
      const int32_t x = fixed((float(begin + k) + 0.5f) * at.scale_u + at.shift_u, columns);
      block.offset[k] = from + (x >> 15) * 4, right[k] = twice(x & (UNIT - 1)), down[k] = below;
    }
    return;
  }
  VECTORISED for (int k = 0; k < count; ++k) {
    const float u = float(begin + k) + 0.5f, relief = upper[begin + k] + (lower[begin + k] - upper[begin + k]) * share;
    const int32_t x = fixed(u * at.scale_u + at.shift_u + relief * (u * push.scale_u + push.shift_u), columns);
    const int32_t y = fixed(v + relief * push_v, rows);
    block.offset[k] = (y >> 15) * stride + (x >> 15) * 4;
    right[k] = twice(x & (UNIT - 1)), down[k] = twice(y & (UNIT - 1));
  }
}

// Return the relief at a position in its pixels.
INLINE float relief_at(const Shown &shown, float x, float y) {
  x = std::min(std::max(x, 0.0f), float(shown.relief_columns - 1)), y = std::min(std::max(y, 0.0f), float(shown.relief_rows - 1));
  // Clamped again as integers, because a position is not a number at the homography's horizon.
  const int column = std::clamp(int(x), 0, shown.relief_columns - 1), row = std::clamp(int(y), 0, shown.relief_rows - 1);
  const float *line = shown.relief + int64_t(row) * shown.relief_columns + column;
  const int next = column + 1 < shown.relief_columns, below = row + 1 < shown.relief_rows ? shown.relief_columns : 0;
  const float right = x - float(column), top = line[0] + (line[next] - line[0]) * right;
  return top + (line[below] + (line[below + next] - line[below]) * right - top) * (y - float(row));
}

// Do the same for a panel with a homography, and find which pixels are inside the panel.
INLINE void locate_registered(const Shown &shown, int r, int begin, int count, Block &block) {
  const ScaleShift at = shown.source_from_panel, push = shown.push;
  const int32_t stride = int32_t(shown.source_stride), rows = shown.source_rows, columns = shown.source_columns;
  const float *h = shown.panel_from_screen, y = float(r) + 0.5f;
  const float u0 = h[1] * y + h[2], v0 = h[4] * y + h[5], w0 = h[7] * y + h[8], uu = h[0], vu = h[3], wu = h[6];
  const float right_px = float(shown.panel_columns), below_px = float(shown.panel_rows);
  auto *right = reinterpret_cast<Word *>(block.right), *down = reinterpret_cast<Word *>(block.down);
  auto *inside = reinterpret_cast<Word *>(block.inside);
  float raised[BLOCK_PX] = {};
  if (shown.relief) {
    const ScaleShift to = shown.relief_from_screen;
    for (int k = 0; k < count; ++k) {
      const float x = float(begin + k) + 0.5f, w = w0 + wu * x;
      raised[k] = relief_at(shown, (u0 + uu * x) / w * to.scale_u + to.shift_u, (v0 + vu * x) / w * to.scale_v + to.shift_v);
    }
  }
  VECTORISED for (int k = 0; k < count; ++k) {
    const float x = float(begin + k) + 0.5f, w = w0 + wu * x;
    const float u = (u0 + uu * x) / w, v = (v0 + vu * x) / w, relief = raised[k];
    const int32_t at_u = fixed(u * at.scale_u + at.shift_u + relief * (u * push.scale_u + push.shift_u), columns);
    const int32_t at_v = fixed(v * at.scale_v + at.shift_v + relief * (v * push.scale_v + push.shift_v), rows);
    block.offset[k] = (at_v >> 15) * stride + (at_u >> 15) * 4;
    right[k] = twice(at_u & (UNIT - 1)), down[k] = twice(at_v & (UNIT - 1));
    inside[k] = -uint32_t((w > 0) & (u >= 0) & (u < right_px) & (v >= 0) & (v < below_px));
  }
}

INLINE void clear_outside(int count, Block &block) {
  VECTORISED for (int k = 0; k < 2 * count; ++k)
    block.even[k] = int16_t(block.even[k] & block.inside[k]), block.odd[k] = int16_t(block.odd[k] & block.inside[k]);
}

template <typename Half>
INLINE int16_t bilinear(const Block &block, int k, Half half) {
  const int16_t right = int16_t(block.right[k]);
  return between(between(half(block.near[0][k]), half(block.near[1][k]), right),
                 between(half(block.near[2][k]), half(block.near[3][k]), right), int16_t(block.down[k]));
}

// Interpolate a block that has been located.
INLINE void interpolate(const Shown &shown, int count, Block &block) {
  auto *top_left = reinterpret_cast<Word *>(block.near[0]), *top_right = reinterpret_cast<Word *>(block.near[1]);
  auto *bottom_left = reinterpret_cast<Word *>(block.near[2]), *bottom_right = reinterpret_cast<Word *>(block.near[3]);
  for (int k = 0; k < count; ++k) {
    uint64_t above, below;  // two neighbours each
    std::memcpy(&above, shown.source + block.offset[k], 8);
    std::memcpy(&below, shown.source + block.offset[k] + shown.source_stride, 8);
    top_left[k] = uint32_t(above), top_right[k] = uint32_t(above >> 32);
    bottom_left[k] = uint32_t(below), bottom_right[k] = uint32_t(below >> 32);
  }
  VECTORISED for (int k = 0; k < 2 * count; ++k)
    block.even[k] = bilinear(block, k, even_of), block.odd[k] = bilinear(block, k, odd_of);
}

INLINE void mix_in(const uint8_t *flat, int16_t weight, int count, Block &block) {
  const auto *pairs = reinterpret_cast<const Pair *>(flat);
  VECTORISED for (int k = 0; k < 2 * count; ++k) {
    block.even[k] = between(block.even[k], even_of(pairs[k]), weight);
    block.odd[k] = between(block.odd[k], odd_of(pairs[k]), weight);
  }
}

// Return a value's entry in a grey curve.
INLINE int16_t entry_of(int16_t value) {
  constexpr int shift = FRACTION - 2;
  return int16_t(uint16_t(value + (1 << (shift - 1))) >> shift);
}

INLINE void store(const Shown &shown, uint8_t *screen, int count, Block &block) {
  if (!shown.curve) {
    auto *pairs = reinterpret_cast<Pair *>(screen);
    auto *red_and_blue = reinterpret_cast<Word *>(block.even);
    VECTORISED for (int k = 0; k < count; ++k) red_and_blue[k] = rotated(red_and_blue[k]);
    VECTORISED for (int k = 0; k < 2 * count; ++k) pairs[k] = pair_of(block.even[k], block.odd[k]);
    return;
  }
  VECTORISED for (int k = 0; k < 2 * count; ++k)
    block.even[k] = entry_of(block.even[k]), block.odd[k] = entry_of(block.odd[k]);
  auto *pixels = reinterpret_cast<Word *>(screen);
  const uint32_t *blue = shown.curve, *green = blue + CURVE, *red = green + CURVE;
  for (int k = 0; k < count; ++k)
    pixels[k] = blue[block.even[2 * k + 1]] | green[block.odd[2 * k]] | red[block.even[2 * k]];
}

INLINE void draw_row(const Shown &shown, int r, uint8_t *screen, Relief &kept, Block &block) {
  const float *upper = nullptr, *lower = nullptr;
  float share = 0;
  if (shown.relief && !shown.registered) {
    const ScaleShift &at = shown.relief_from_screen;
    const float v = std::clamp((float(r) + 0.5f) * at.scale_v + at.shift_v, 0.0f, float(shown.relief_rows - 1));
    share = v - float(int(v));
    upper = relief_row(shown, kept, int(v)), lower = relief_row(shown, kept, std::min(int(v) + 1, shown.relief_rows - 1));
  }
  for (int c = 0; c < shown.columns; c += BLOCK_PX) {
    const int count = std::min(BLOCK_PX, shown.columns - c), n = c / BLOCK_PX;
    const bool rises = upper && (kept.rises[0][n] || kept.rises[1][n]);
    if (shown.registered) locate_registered(shown, r, c, count, block);
    else locate(shown, r, c, count, rises ? upper : nullptr, lower, share, block);
    interpolate(shown, count, block);
    if (shown.registered) clear_outside(count, block);
    if (shown.flat) {
      const uint8_t *flat = shown.flat + r * shown.flat_stride + 4 * c;
      mix_in(flat, int16_t(shown.flatness * (UNIT - 1) + 0.5f), count, block);
    }
    store(shown, screen + 4 * c, count, block);
  }
}

// Return a map for a picture of every other pixel: its pixel (k, l) is the screen's pixel (2k, 2l).
INLINE ScaleShift halved(const ScaleShift &map) {
  return {2 * map.scale_u, 2 * map.scale_v, map.shift_u - 0.5f * map.scale_u, map.shift_v - 0.5f * map.scale_v};
}

INLINE Shown halved(const Shown &shown) {
  Shown half = shown;
  half.rows = shown.rows / 2 + 1, half.columns = shown.columns / 2 + 1;
  if (shown.registered) {
    for (float *row = half.panel_from_screen; row < half.panel_from_screen + 9; row += 3)
      row[2] -= 0.5f * (row[0] + row[1]), row[0] *= 2, row[1] *= 2;
  } else {
    half.source_from_panel = halved(shown.source_from_panel);
    half.push = halved(shown.push);
    half.relief_from_screen = halved(shown.relief_from_screen);
  }
  half.curve = nullptr;
  return half;
}

INLINE uint32_t average(uint32_t a, uint32_t b) { return (a | b) - ((a ^ b) >> 1 & 0x7F7F7F7F); }  // of each byte

INLINE void average(const uint32_t *a, const uint32_t *b, uint32_t *to, int count) {
  VECTORISED for (int k = 0; k < count; ++k) to[k] = average(a[k], b[k]);
}

INLINE uint8_t *bytes_of(std::vector<uint32_t> &line) { return reinterpret_cast<uint8_t *>(line.data()); }

// Draw a row from every other pixel, and apply the curve.
INLINE void widen(const Shown &shown, const uint32_t *line, uint8_t *screen) {
  auto *pixels = reinterpret_cast<Word *>(screen);
  const int step = CURVE / 256, pairs = shown.columns / 2;
  const uint32_t *blue = shown.curve, *green = blue + CURVE, *red = green + CURVE;
  const auto curved = [&](uint32_t pixel) {
    return blue[(pixel & 255) * step] | green[(pixel >> 8 & 255) * step] | red[(pixel >> 16 & 255) * step];
  };
  uint32_t between[BLOCK_PX];
  if (shown.curve) {
    for (int from = 0; from < pairs; from += BLOCK_PX) {
      const int count = std::min(BLOCK_PX, pairs - from);
      average(line + from, line + from + 1, between, count);
      for (int k = 0; k < count; ++k)
        pixels[2 * (from + k)] = curved(line[from + k]), pixels[2 * (from + k) + 1] = curved(between[k]);
    }
  } else {
    VECTORISED for (int k = 0; k < pairs; ++k) pixels[2 * k] = line[k], pixels[2 * k + 1] = average(line[k], line[k + 1]);
  }
  if (shown.columns % 2) pixels[shown.columns - 1] = shown.curve ? curved(line[pairs]) : line[pairs];
}

INLINE void draw_rows_any(const Shown &shown, int begin, int end, Memory &memory) {
  Block block;
  Relief &kept = memory.kept;
  if (shown.every == 1) {
    if (shown.relief) prepare(shown, kept);
    for (int r = begin; r < end; ++r)
      if (!copied(shown, r)) draw_row(shown, r, shown.screen + r * shown.screen_stride, kept, block);
    return;
  }
  const Shown half = halved(shown);
  if (half.relief) prepare(half, kept);
  auto &lines = memory.lines;
  for (auto *line : {lines, lines + 1, &memory.between_lines}) line->resize(half.columns);
  draw_row(half, begin / 2, bytes_of(lines[begin / 2 & 1]), kept, block);
  for (int r = begin; r < end; ++r) {
    const uint32_t *line = lines[r / 2 & 1].data();
    if (r % 2) {
      draw_row(half, r / 2 + 1, bytes_of(lines[(r / 2 + 1) & 1]), kept, block);
      average(line, lines[(r / 2 + 1) & 1].data(), memory.between_lines.data(), half.columns);
      line = memory.between_lines.data();
    }
    widen(shown, line, shown.screen + r * shown.screen_stride);
  }
}

FOR_EVERY_LEVEL(draw_rows, void, (const Shown &shown, int begin, int end, Memory &memory), (shown, begin, end, memory))

struct Part {
  const Shown *shown;
  int count, part, parts;
  Memory memory;
};

void *draw_part(void *given) {
  Part &part = *static_cast<Part *>(given);
  for (const Shown *shown = part.shown; shown < part.shown + part.count; ++shown)
    draw_rows(*shown, shown->rows * part.part / part.parts, shown->rows * (part.part + 1) / part.parts, part.memory);
  return nullptr;
}

// Start a thread with the caller's priority, which it would not inherit (SCHED_RESET_ON_FORK). If it got the priority
// only later, it would often wait on the caller's core for the caller to finish.
bool start(pthread_t &thread, Part &part) {
  int policy = 0;
  sched_param level{};
  pthread_attr_t like_caller;
#ifdef SCHED_RESET_ON_FORK  // Linux, where pthread_getschedparam may return a former priority
  policy = sched_getscheduler(0) & ~SCHED_RESET_ON_FORK;
  sched_getparam(0, &level);
#endif
  if (pthread_attr_init(&like_caller) != 0) return false;
  if (policy == SCHED_RR || policy == SCHED_FIFO) {
    pthread_attr_setinheritsched(&like_caller, PTHREAD_EXPLICIT_SCHED);
    pthread_attr_setschedpolicy(&like_caller, policy);
    pthread_attr_setschedparam(&like_caller, &level);
  }
  const bool started = pthread_create(&thread, &like_caller, draw_part, &part) == 0 ||
                       pthread_create(&thread, nullptr, draw_part, &part) == 0;  // without the right to the priority
  pthread_attr_destroy(&like_caller);
  return started;
}

}  // namespace

std::array<int, 4> frame_picture(const uint8_t *turned, int64_t row_step, int64_t column_step, int rows, int columns, uint8_t *framed, int border_px, int extended) {
  const int width = columns + 2 * border_px;
  auto *middle = reinterpret_cast<Word *>(framed) + border_px * (width + 1);
  const Word border = *reinterpret_cast<const Word *>(framed) << 8;  // without alpha
  int left = columns, top = rows, right = 0, bottom = 0;
  for (int r = 0; r < rows; ++r) {
    const uint8_t *from = turned + r * row_step;
    Word *to = middle + int64_t(r) * width;
    if (column_step == 4) std::memcpy(to, from, size_t(columns) * 4);
    else
      for (int c = 0; c < columns; ++c) to[c] = *reinterpret_cast<const Word *>(from + c * column_step);
    int first = 0, end = columns;
    while (first < columns && to[first] << 8 == border) ++first;
    while (end > first && to[end - 1] << 8 == border) --end;
    if (first < end) left = std::min(left, first), right = std::max(right, end), top = std::min(top, r), bottom = r + 1;
    if (extended) to[-1] = to[0], to[columns] = to[columns - 1];
  }
  if (extended) {
    Word *last = middle + int64_t(rows - 1) * width;
    std::memcpy(middle - width - 1, middle - 1, size_t(columns + 2) * 4);
    std::memcpy(last + width - 1, last - 1, size_t(columns + 2) * 4);
  }
  return {left + border_px, top + border_px, right + border_px, bottom + border_px};
}

void draw_panels(const Shown *shown, int count, int threads) {
  const int parts = std::clamp(threads, 1, MAX_THREADS);
  Part part[MAX_THREADS];
  pthread_t thread[MAX_THREADS];
  bool started[MAX_THREADS] = {};
  for (int n = 0; n < parts; ++n) {
    part[n] = {shown, count, n, parts, {}};
    for (int k = 0; k < count; ++k) part[n].memory.reserve(size_t(shown[k].columns) + 1);
  }
  for (int n = 1; n < parts; ++n) started[n] = start(thread[n], part[n]);
  for (int n = 0; n < parts; ++n)
    if (!started[n]) draw_part(&part[n]);
  for (int n = 1; n < parts; ++n)
    if (started[n]) pthread_join(thread[n], nullptr);
}
