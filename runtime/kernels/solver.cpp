// Solver steps on the processor (docs/mathematics.md, L1 to L5). The reference implementation is model_export/light.py.
//
// Rays are processed row by row, and their residuals are stored in a ring buffer of rows. A panel row is updated once
// all the rays that cross it have been processed. Its phasors are kept in another ring buffer, from the first ray that
// needs them to the last. Only the panels are read from and written to main memory.
#include "solver.hpp"

namespace {

constexpr int FULL = 255 * 16;   // a panel value of 1, in sixteenths of a code
constexpr float UNIT = 8100;     // 1 in fixed-point phasors; rounded products must stay within 8191
constexpr float PI = 3.14159265f;
constexpr double NEAR_PX = 0.5;  // rays count if they cross every panel at least this far inside its edges
constexpr double EDGE_CLAMP_PX = 2;  // bundles of rays at the border extend this far beyond the picture (clamp to edge)
static_assert(2 * FIELDS <= 2 * MAX_PANELS, "work has too few tiles to add a set to the sum of the others");

// The part of the work done by one thread: rows of rays, and the panel rows that can be updated once they are done.
struct Share {
  int first, end;  // rows of rays
  std::vector<int> since[MAX_PANELS], until[MAX_PANELS];  // first and last ray row that crosses each panel row
  int panel_first[MAX_PANELS], panel_end[MAX_PANELS];     // rows of each panel to update
  int16_t *ring;          // ring buffer for the rays' residuals
  int64_t stride, plane;  // elements per row and per field
  int rows;               // number of rows in this ring buffer
  Image cosine[MAX_PANELS], sine[MAX_PANELS];  // phasors: cosine and sine of pi times `ahead`

  int16_t *field(int set, int f) const { return ring + (int64_t(set) * FIELDS + f) * plane; }
  int16_t *row(int set, int f, int r) const { return field(set, f) + int64_t(r % rows) * stride; }
  Image image(const Problem &problem, int set, int f) const {
    return {field(set, f), stride, problem.height, problem.width, rows};
  }
};

struct Range {
  double low, high;
};

// Return the range of ray rows, over all sets, that cross row q in panel n.
Range rays_through(const Problem &problem, int n, int q) {
  const double right = problem.panel[n].ahead.width - 0.5;
  constexpr double everywhere = 1e9, horizon = 1e-6;
  Range rays{everywhere, -everywhere};
  for (int set = 0; set < problem.sets; ++set) {
    const Line line(problem.rays_from_panels.data() + (set * problem.panels + n) * 9, q);
    if (!(std::min(line.w0 - 0.5 * line.wu, line.w0 + right * line.wu) > horizon)) return {-everywhere, everywhere};
    const double top = line.y(-0.5), bottom = line.y(right), run = std::abs(line.x(right) - line.x(-0.5));
    const double margin = 2 * std::abs(bottom - top) / std::max(run, 0.5);  // extends the line by two pixels
    rays.low = std::min({rays.low, top - margin, bottom - margin});
    rays.high = std::max({rays.high, top + margin, bottom + margin});
  }
  return rays;
}

// Compute `since` and `until` for each row in a panel. Neither decreases from one row to the next.
void find_dependencies(const Problem &problem, int n, Share &share) {
  const int rows = problem.panel[n].ahead.rows;
  const double last = problem.height - 1.0;
  std::vector<int> &since = share.since[n], &until = share.until[n];
  since.resize(rows), until.resize(rows);
  for (int q = 0, latest = 0; q < rows; ++q) {
    const Range rays = rays_through(problem, n, q);
    since[q] = int(std::clamp(std::floor(rays.low), 0.0, last));
    until[q] = latest = std::max(latest, int(std::clamp(std::floor(rays.high) + 1, 0.0, last)));
  }
  for (int q = rows - 2; q >= 0; --q) since[q] = std::min(since[q], since[q + 1]);
}

// Return the first panel row that ray row r or a later one still crosses.
int first_until(const std::vector<int> &until, int r) {
  return int(std::lower_bound(until.begin(), until.end(), r) - until.begin());
}

// Divide the ray rows evenly between the parts. Each part updates the panel rows whose last ray is in its range, so it
// must also process all the earlier rays that cross these panel rows.
void assign_rows(const Problem &problem, int part, int parts, Share &share) {
  const int first = int(int64_t(problem.height) * part / parts);
  share.first = first, share.end = int(int64_t(problem.height) * (part + 1) / parts);
  for (int n = 0; n < problem.panels; ++n) {
    const std::vector<int> &until = share.until[n];
    const int begin = share.panel_first[n] = part == 0 ? 0 : first_until(until, first);
    share.panel_end[n] = part == parts - 1 ? int(until.size()) : first_until(until, share.end);
    if (begin < share.panel_end[n]) share.first = std::min(share.first, share.since[n][begin]);
  }
}

// Return the number of ray rows to keep in the ring buffer: those from the first to the last that cross a panel row,
// and one more.
int ray_rows(const std::vector<int> &since, const std::vector<int> &until) {
  int rows = 1;
  for (size_t q = 0; q < since.size(); ++q) rows = std::max(rows, until[q] - since[q] + 2);
  return rows;
}

// Return the maximum number of a panel's phasor rows in use at the same time. Rays between two panel rows read both, so
// a row's phasors are needed from the first ray of the row before it to the last ray of the row after it.
int phasor_rows(const std::vector<int> &since, const std::vector<int> &until) {
  int rows = 2;
  for (int q = 0, oldest = 0; q < int(since.size()); ++q) {
    while (oldest < q && until[oldest + 1] < since[std::max(q - 1, 0)]) ++oldest;
    rows = std::max(rows, q - oldest + 3);
  }
  return rows;
}

int64_t stride_of(const Problem &problem, int width) { return whole_vectors(int64_t(width) * problem.channels + LANES); }

// Lay out the ring buffers in memory that the thread keeps for later calls.
void lay_out(const Problem &problem, bool phasors, Share &share) {
  static thread_local std::vector<int16_t> memory;
  share.rows = 1;
  int64_t of_phasors = 0;
  for (int n = 0; n < problem.panels; ++n) {
    const Image &panel = problem.panel[n].ahead;
    share.rows = std::max(share.rows, ray_rows(share.since[n], share.until[n]));
    if (!phasors) continue;
    const int32_t rows = phasor_rows(share.since[n], share.until[n]);
    share.cosine[n] = share.sine[n] = {nullptr, stride_of(problem, panel.width), panel.rows, panel.width, rows};
    of_phasors += 2 * rows * share.cosine[n].stride;
  }
  share.stride = stride_of(problem, problem.width), share.plane = share.stride * share.rows;
  const int64_t of_rays = problem.sets * FIELDS * share.plane + 2 * LANES;
  memory.resize(size_t(of_rays + of_phasors + 3 * LANES));
  share.ring = memory.data() + (LANES - (reinterpret_cast<uintptr_t>(memory.data()) / sizeof(int16_t)) % LANES);
  int16_t *at = share.ring + of_rays;
  for (int n = 0; phasors && n < problem.panels; ++n)
    for (Image *image : {share.cosine + n, share.sine + n}) image->data = at, at += image->stride * image->ring;
}

Share share_of(const Problem &problem, int part, int parts, bool phasors) {
  Share share;
  for (int n = 0; n < problem.panels; ++n) find_dependencies(problem, n, share);
  assign_rows(problem, part, parts, share);
  lay_out(problem, phasors, share);
  return share;
}

// Fixed-point constants. The first four are the coefficients of x, x^3, x^5 and x^7 in a polynomial for sin(pi/2 x),
// and `unit` is UNIT; for all of these, 16384 stands for 1. `beyond_eight` is 32768 / FULL - 8, with 32768 standing for
// 1.
struct Factors {
  int16_t first = 25736, third = -10583, fifth = 1302, seventh = -71, unit = int16_t(UNIT * 2), beyond_eight = 1028;
};

// Return UNIT times the cosine of an angle, where 32768 stands for half a turn.
INLINE int16_t cosine_of(int16_t angle, const Factors &by) {
  const int16_t within = int16_t(16384 - (angle < 0 ? -angle : angle));  // sine argument, at most a quarter turn
  const int16_t x = int16_t(2 * within - (within >> 14)), y = product(x, x);  // subtracting 1 avoids 32768
  const int16_t series = int16_t(by.third + product(y, int16_t(by.fifth + product(y, by.seventh))));
  return product(product(x, int16_t(by.first + product(y, series))), by.unit);
}

// Compute the cosine and sine of pi times the values in row q of panel n.
INLINE void to_phasors(const Problem &problem, const Share &share, int n, int q) {
  Factors by;
  asm("" : "+m"(by));  // hides the constants from GCC, which would expand the products and take four times as long
  const int16_t *row = problem.panel[n].ahead.row(q);
  int16_t *cosine = const_cast<int16_t *>(share.cosine[n].row(q)), *sine = const_cast<int16_t *>(share.sine[n].row(q));
  const int count = problem.panel[n].ahead.width * problem.channels;
  VECTORISED for (int k = 0; k < count; ++k) {
    const int16_t angle = int16_t(8 * row[k] + product(row[k], by.beyond_eight));
    cosine[k] = cosine_of(angle, by), sine[k] = cosine_of(int16_t(angle - 16384), by);
  }
}

INLINE void clear_outside(const Problem &problem, const Share &share, int set, int r, Span span) {
  const int C = problem.channels;
  for (int f = 0; f < FIELDS; ++f) {
    int16_t *row = share.row(set, f, r);
    std::memset(row, 0, size_t(span.first) * C * sizeof *row);
    std::memset(row + span.last * C, 0, size_t(share.stride - span.last * C) * sizeof *row);
  }
}

// Return the fixed-point value that stands for 1 in the product of the panels' phasors.
INLINE float unit_of(int panels) {
  float unit = UNIT;
  for (int n = 1; n < panels; ++n) unit *= UNIT / 8192;
  return unit;
}

// Compute the squared slope (curvature) and the error times the slope (gradient) for row r of a ray set.
template <int C, int N>
INLINE void compare(const Problem &problem, const Share &share, int set, int r, Work &work) {
  Line lines[N];
  Span span{0, problem.width};
  for (int n = 0; n < N; ++n) {
    lines[n] = Line(problem.panels_from_rays.data() + (set * N + n) * 9, r);
    span = common(span, inside(lines[n], problem.width, problem.panel[n].ahead, NEAR_PX));
  }
  const int16_t one = rounded(unit_of(N)), twice = rounded(512.0f / 255 * unit_of(N));
  const int halvings = problem.halvings();
  const int16_t row_taper = int16_t(problem.rays->row_taper[problem.row(set, r)] >> halvings);
  const int16_t a = halvings < 2 ? 2 : 1, b = halvings < 1 ? 2 : 1;  // factors of the squared slope
  int tile = TILE_PX;
  for (const Line &line : lines) tile = std::min(tile, tile_px(line, span));
  for (int u = span.first; u < span.last; u += tile) {
    const int end = std::min(u + tile, span.last), count = (end - u) * C;
    for (int n = 0; n < N; ++n) {
      const Image phasor[2] = {share.cosine[n], share.sine[n]};
      sample<2, C>(phasor, lines[n], u, end, work, work.tile + 2 * n);
    }
    const int64_t at = int64_t(u) * C;
    const uint8_t *target = problem.target(set, r, at);
    const int16_t *taper = problem.rays->column_taper.data() + at;
    int16_t *curvature = share.row(set, 0, r) + at, *gradient = share.row(set, 1, r) + at;
    for (int e = 0; e < count; e += LANES)
      VECTORISED for (int k = e; k < e + LANES; ++k) {
        int16_t re = work.tile[0][k], im = work.tile[1][k];
        for (int n = 1; n < N; ++n) {
          const int16_t c = work.tile[2 * n][k], s = work.tile[2 * n + 1][k], p = int16_t(4 * re), q = int16_t(4 * im);
          re = int16_t(product(p, c) - product(q, s)), im = int16_t(product(p, s) + product(q, c));
        }
        const int16_t doubled = product(int16_t(target[k] << 7), twice);
        const int16_t error = product(int16_t(one - re - doubled), product(taper[k], row_taper));  // twice the error
        curvature[k] = product(int16_t(a * im), int16_t(b * im)), gradient[k] = product(error, int16_t(2 * im));
      }
  }
  clear_outside(problem, share, set, r, span);
}

// A panel row, mapped to the rays of each set.
struct Back {
  Line line[MAX_SETS];
  Span span[MAX_SETS];
  Back(const Problem &problem, const Share &share, int n, int q) {
    for (int set = 0; set < problem.sets; ++set) {
      line[set] = Line(problem.rays_from_panels.data() + (set * problem.panels + n) * 9, q);
      span[set] = inside(line[set], problem.panel[n].ahead.width, share.image(problem, set, 0), -EDGE_CLAMP_PX);
    }
  }
};

// Sum the rays' first F fields over all sets at the pixels of a panel row. The sums are stored in work.tile[0] to
// work.tile[F - 1].
template <int F, int C>
INLINE void gather(const Problem &problem, const Share &share, const Back &back, Span tile, Work &work) {
  const int count = (tile.last - tile.first) * C;
  for (int set = 0; set < problem.sets; ++set) {
    Image images[F];
    for (int f = 0; f < F; ++f) images[f] = share.image(problem, set, f);
    const Span span = common(tile, back.span[set]);
    int16_t(*out)[TILE] = work.tile + (set == 0 ? 0 : F);
    const int begin = std::max(span.first - tile.first, 0) * C, end = std::max(span.last - tile.first, 0) * C;
    for (int u = span.first, length = tile_px(back.line[set], span); u < span.last; u += length)
      sample<F, C>(images, back.line[set], u, std::min(u + length, span.last), work, out, (u - tile.first) * C);
    for (int f = 0; f < F; ++f) {
      std::memset(out[f], 0, size_t(begin) * sizeof *out[f]);
      std::memset(out[f] + end, 0, size_t(count - end) * sizeof *out[f]);
      if (set == 0) continue;
      int16_t *sum = work.tile[f];
      for (int e = 0; e < count; e += LANES)
        VECTORISED for (int k = e; k < e + LANES; ++k) sum[k] = int16_t(sum[k] + out[f][k]);
    }
  }
}

// Replace the first `count` elements by each pixel's mean over the channels.
template <int C>
INLINE void mean_of_channels(int16_t *row, int64_t count) {
  for (int64_t k = 0; C == 3 && k < count; k += 3) {
    const int16_t mean = int16_t((int(row[k]) + row[k + 1] + row[k + 2]) / 3);
    row[k] = row[k + 1] = row[k + 2] = mean;
  }
}

// Update row q of panel n by a gradient step with momentum (L5).
template <int C, int N>
INLINE void move(const Problem &problem, const Update &update, const Share &share, int n, int q, Work &work) {
  const Panel &panel = problem.panel[n];
  const Back back(problem, share, n, q);
  const float least = update.floor * float(problem.sets) * unit_of(N) * unit_of(N) / 8192 / float(1 << problem.halvings());
  const float size = update.size * FULL / (N * PI / 2);
  const int16_t momentum = rounded(32768 * update.momentum);
  for (int u = 0; u < panel.ahead.width; u += TILE_PX) {
    const Span tile{u, std::min(u + TILE_PX, panel.ahead.width)};
    gather<2, C>(problem, share, back, tile, work);
    const int64_t at = int64_t(u) * C, count = int64_t(tile.last - u) * C;
    if (problem.grey[n]) mean_of_channels<C>(work.tile[0], count), mean_of_channels<C>(work.tile[1], count);
    const int16_t *ahead = panel.ahead.row(q) + at, *before = panel.before.row(q) + at;
    int16_t *last = const_cast<int16_t *>(panel.last.row(q)) + at, *moved = const_cast<int16_t *>(panel.moved.row(q)) + at;
    for (int e = 0; e < count; e += LANES)
      VECTORISED for (int k = e; k < e + LANES; ++k) {
        const float change = size * float(work.tile[1][k]) / std::max(float(work.tile[0][k]), least);
        const int16_t now = rounded(std::min(std::max(float(ahead[k]) - change, 0.0f), float(FULL)));
        moved[k] = int16_t(now + product(int16_t(now - before[k]), momentum));
        last[k] = now;
      }
  }
}

// For row r of a ray set, compute the targets' weights, and their products with the residuals that the middle panel
// must correct.
template <int C>
INLINE void residual(const Problem &problem, const Share &share, int set, int r, Work &work) {
  const int middle = problem.panels / 2, halvings = problem.halvings();
  const int32_t *table = problem.rays->table.data();
  const int16_t rest = int16_t(problem.rays->rest);
  const float missing = problem.rays->missing;
  const double *homographies = problem.panels_from_rays.data() + set * problem.panels * 9;
  const Span span = inside(Line(homographies + middle * 9, r), problem.width, problem.panel[middle].last, 0);
  Span whole = span;  // rays that cross all panels
  for (int n = 0; n < problem.panels; ++n)
    whole = common(whole, inside(Line(homographies + n * 9, r), problem.width, problem.panel[n].last, 0));
  for (int u = span.first; u < span.last; u += TILE_PX) {
    const Span tile{u, std::min(u + TILE_PX, span.last)};
    const int count = (tile.last - u) * C;
    int16_t *sum = work.sum;
    std::fill(sum, sum + TILE, int16_t(0));
    for (int n = 0; n < problem.panels; ++n) {
      if (n == middle) continue;
      const Line line(homographies + n * 9, r);
      const Span seen = common(tile, inside(line, problem.width, problem.panel[n].last, 0));
      int16_t *one = work.tile[0], *begin = one + std::max(seen.first - u, 0) * C, *end = one + std::max(seen.last - u, 0) * C;
      for (int v = seen.first, length = tile_px(line, seen); v < seen.last; v += length)
        sample<1, C>(&problem.panel[n].last, line, v, std::min(v + length, seen.last), work, work.tile, (v - u) * C);
      std::fill(one, begin, rest), std::fill(end, one + count, rest);
      for (int e = 0; e < count; e += LANES)
        VECTORISED for (int k = e; k < e + LANES; ++k) sum[k] = int16_t(sum[k] + one[k]);
    }
    const int64_t at = int64_t(u) * C;
    const uint8_t *target = problem.target(set, r, at);
    int16_t *weights = share.row(set, 0, r) + at, *weighted = share.row(set, 1, r) + at;
    for (int e = 0; e < count; e += LANES)
      VECTORISED for (int k = e; k < e + LANES; ++k) {
        const int32_t entry = table[target[k]];
        const int16_t left = int16_t(int16_t(entry) - sum[k]);
        sum[k] = std::min(std::max(left, int16_t(-FULL)), int16_t(2 * FULL)), weights[k] = int16_t(entry >> (16 + halvings));
      }
    const int begin = std::clamp((whole.first - u) * C, 0, count), end = std::clamp((whole.last - u) * C, begin, count);
    for (int k = 0; k < begin; ++k) weights[k] = rounded(float(weights[k]) * missing);
    for (int k = end; k < count; ++k) weights[k] = rounded(float(weights[k]) * missing);
    for (int e = 0; e < count; e += LANES)
      VECTORISED for (int k = e; k < e + LANES; ++k) weighted[k] = product(int16_t(2 * sum[k]), int16_t(2 * weights[k]));
  }
  clear_outside(problem, share, set, r, span);
}

// Set each pixel in row q of the middle panel to the mean residual of the rays that pass through it, or to the rest
// value if there are none.
template <int C>
INLINE void fill(const Problem &problem, const Share &share, int q, Work &work) {
  const Image &image = problem.panel[problem.panels / 2].last;
  const int16_t rest = int16_t(problem.rays->rest);
  const Back back(problem, share, problem.panels / 2, q);
  for (int u = 0; u < image.width; u += TILE_PX) {
    const Span tile{u, std::min(u + TILE_PX, image.width)};
    gather<2, C>(problem, share, back, tile, work);
    if (problem.grey[problem.panels / 2])
      for (int f = 0; f < 2; ++f) mean_of_channels<C>(work.tile[f], int64_t(tile.last - u) * C);
    int16_t *out = const_cast<int16_t *>(image.row(q)) + int64_t(u) * C;
    VECTORISED for (int k = 0; k < (tile.last - u) * C; ++k) {
      const float weight = work.tile[0][k], mean = 8192 * float(work.tile[1][k]) / std::max(weight, 1.0f);
      out[k] = weight > 0 ? rounded(std::min(std::max(mean, 0.0f), float(FULL))) : rest;
    }
  }
}

template <int C, int N>
INLINE void step_rows(const Problem &problem, const Update &update, const Share &share) {
  Work work{};
  int at[N], ready[N];  // for each panel, the next row to update, and the next to convert to phasors
  std::copy(share.panel_first, share.panel_first + N, at);
  for (int n = 0; n < N; ++n)
    ready[n] = std::max(0, first_until(share.until[n], share.first) - 1);
  for (int r = share.first; r < share.end; ++r) {
    for (int n = 0; n < N; ++n)
      for (const int rows = problem.panel[n].ahead.rows; ready[n] < rows && share.since[n][std::max(ready[n] - 1, 0)] <= r; ++ready[n])
        to_phasors(problem, share, n, ready[n]);
    for (int set = 0; set < problem.sets; ++set) compare<C, N>(problem, share, set, r, work);
    for (int n = 0; n < N; ++n)
      while (at[n] < share.panel_end[n] && share.until[n][at[n]] <= r) move<C, N>(problem, update, share, n, at[n]++, work);
  }
}

template <int C>
INLINE void close_rows(const Problem &problem, const Share &share) {
  Work work{};
  const int middle = problem.panels / 2;
  int q = share.panel_first[middle];
  for (int r = share.first; r < share.end; ++r) {
    for (int set = 0; set < problem.sets; ++set) residual<C>(problem, share, set, r, work);
    while (q < share.panel_end[middle] && share.until[middle][q] <= r) fill<C>(problem, share, q++, work);
  }
}

INLINE void step_any(const Problem &problem, const Update &update, int part, int parts) {
  const Share share = share_of(problem, part, parts, true);
  switch (problem.channels * 10 + problem.panels) {
    case 12: return step_rows<1, 2>(problem, update, share);
    case 13: return step_rows<1, 3>(problem, update, share);
    case 14: return step_rows<1, 4>(problem, update, share);
    case 15: return step_rows<1, 5>(problem, update, share);
    case 16: return step_rows<1, 6>(problem, update, share);
    case 32: return step_rows<3, 2>(problem, update, share);
    case 33: return step_rows<3, 3>(problem, update, share);
    case 34: return step_rows<3, 4>(problem, update, share);
    case 35: return step_rows<3, 5>(problem, update, share);
    case 36: return step_rows<3, 6>(problem, update, share);
  }
}

INLINE void close_middle_any(const Problem &problem, int part, int parts) {
  const Share share = share_of(problem, part, parts, false);
  if (problem.channels == 3) close_rows<3>(problem, share);
  else close_rows<1>(problem, share);
}

INLINE void show_any(const int16_t *row, int channels, uint32_t *pixels, int count) {
  if (channels == 1) {
    VECTORISED for (int u = 0; u < count; ++u) pixels[u] = uint32_t((row[u] + 8) >> 4) * 0x10101u | 0xff000000u;
    return;
  }
  VECTORISED for (int u = 0; u < count; ++u) {
    const uint32_t red = uint32_t(row[3 * u] + 8) >> 4, green = uint32_t(row[3 * u + 1] + 8) >> 4;
    pixels[u] = red | green << 8 | (uint32_t(row[3 * u + 2] + 8) >> 4) << 16 | 0xff000000u;
  }
}

}  // namespace

FOR_EVERY_LEVEL(step, void, (const Problem &problem, const Update &update, int part, int parts), (problem, update, part, parts))
FOR_EVERY_LEVEL(close_middle, void, (const Problem &problem, int part, int parts), (problem, part, parts))
FOR_EVERY_LEVEL(show, void, (const int16_t *row, int channels, uint32_t *pixels, int count), (row, channels, pixels, count))

Panels::Panels(int count, int rows, int columns, int channels)
    : count(count), rows(rows), columns(columns), channels(channels) {
  require(count >= 2 && count <= MAX_PANELS, "a solution must have 2 to 6 panels");
  require(rows >= 1 && columns >= 1 && rows <= MAX_SIDE && columns <= MAX_SIDE, "a panel's size is out of range");
  require(channels == 1 || channels == 3, "there must be 1 or 3 channels");
  stride = whole_vectors(int64_t(columns) * channels) + MARGIN;
  for (auto &buffer : buffers) {
    buffer.reset(static_cast<int16_t *>(std::calloc(size_t(count) * (rows + 1) * stride, sizeof(int16_t))));
    if (!buffer) throw std::bad_alloc();
  }
}

Problem::Problem(const Panels &given, bool closing, std::shared_ptr<const Rays> of_rays, std::vector<Size> boxes, std::vector<double> seen, std::vector<double> back, std::vector<RaySet> ray_sets, int turns, std::vector<bool> of_grey)
    : rays(std::move(of_rays)), panels(given.count), sets(int(ray_sets.size())), channels(given.channels),
      width(rays->width), turns(turns), ray_set(std::move(ray_sets)), panels_from_rays(std::move(seen)),
      rays_from_panels(std::move(back)), grey(std::move(of_grey)) {
  require(rays->channels == channels, "the targets and the panels have different numbers of channels");
  require(sets >= 1 && sets <= MAX_SETS, "the number of ray sets is out of range");
  require(turns >= 1 && turns <= rays->rows, "more sets take turns than there are rows of rays");
  height = rays->rows / turns;
  for (const RaySet &set : ray_set)
    require(set.view >= 0 && set.view < int(rays->targets.size()) && set.turn >= 0 && set.turn < turns, "a ray set has no picture or turn");
  require(int(boxes.size()) == panels && int(grey.size()) == panels, "each panel must have a box, and be grey or not");
  const int64_t entries = int64_t(sets) * panels * 9;
  require(int64_t(panels_from_rays.size()) == entries && int64_t(rays_from_panels.size()) == entries,
          "each ray set must have a homography and its inverse for each panel");
  require(usable(panels_from_rays.data(), entries / 9) && usable(rays_from_panels.data(), entries / 9),
          "a homography is not finite");
  const Panels::Roles roles = closing ? Panels::Roles{given.ahead, given.last, given.moved, given.last} : given.roles();
  for (int n = 0; n < panels; ++n) {
    const int rows = boxes[n].first, columns = boxes[n].second;
    require(rows >= 1 && columns >= 1 && rows <= given.rows && columns <= given.columns, "a box is larger than its panel");
    const auto image = [&](int buffer) { return Image{given.row(buffer, n, 0), given.stride, rows, columns, rows}; };
    panel[n] = {image(roles.ahead), image(roles.moved), image(roles.before), image(roles.last)};
  }
}
