// The solver's steps on the processor (docs/mathematics.md, L1 to L5; model_export/light.py is the reference).
//
// Rays are compared row by row, and what they see wrong waits in a ring of rows until all rays through a row of a panel
// have been compared: then that row moves. Its phasors live in a ring as well, from the first of its rays to the last:
// memory that is read and written holds nothing but the panels.
#include <vector>

#include "sampling.hpp"

namespace {

constexpr float FULL = 255 * 16;  // of a panel that shows 1: sixteenths of a code
constexpr float UNIT = 8191;      // of 1 in phasors, and in what goes back to the panels
constexpr float PI = 3.14159265f;
constexpr double NEAR_PX = 0.5;   // a ray counts that crosses every panel so far inside its edges

struct Panel {
  Image ahead;  // what the rays see: with momentum
  Image moved;  // the same after the step
  Image last;   // without momentum, read and written
};

struct Problem {
  int32_t panels, sets, channels;  // sets of rays: left and right eye in turn, for each place that they may be at
  int32_t height, width;           // of the rays' raster
  const double *panels_from_rays;  // (sets, panels, 3, 3)
  const double *rays_from_panels;  // their inverses
  const uint8_t *targets[2];       // left and right eye's, (height, width, channels)
  const float *column_taper;       // (width, channels) what the rays' errors are multiplied with
  const float *row_taper;          // (height)
  const float *table;              // (256, 2): of a target's code, the sum of all panels that shows it, and its weight
  float rest, missing;             // closing: what lies beside a panel counts for; weight of a ray that misses one
  Panel panel[MAX_PANELS];
  float size, momentum, floor;
};

// What one thread does: rows of rays, and those of panels that are complete by then.
struct Share {
  int first, end;
  std::vector<int> since[MAX_PANELS], until[MAX_PANELS];  // first and last row of rays that see each row of a panel
  int panel_first[MAX_PANELS], panel_end[MAX_PANELS];
  int16_t *ring;
  int64_t stride, plane;  // of a row, of one field
  int rows, fields;
  Image cosine[MAX_PANELS], sine[MAX_PANELS];  // of pi times what the rays see

  int16_t *field(int set, int f) const { return ring + (int64_t(set) * fields + f) * plane; }
  int16_t *row(int set, int f, int r) const { return field(set, f) + int64_t(r % rows) * stride; }
  Image image(const Problem &problem, int set, int f) const {
    return {field(set, f), stride, problem.height, problem.width, rows};
  }
};

Share share_of(const Problem &problem, int part, int parts, int fields, bool phasors) {
  static thread_local std::vector<int16_t> memory;
  const int height = problem.height;
  Share share;
  share.first = int(int64_t(height) * part / parts), share.end = int(int64_t(height) * (part + 1) / parts);
  share.rows = 1, share.fields = fields;
  int begin = share.first;
  int64_t held[MAX_PANELS], total = 0;
  for (int n = 0; n < problem.panels; ++n) {
    const Image &image = problem.panel[n].ahead;
    std::vector<int> &since = share.since[n], &until = share.until[n];
    since.resize(image.rows), until.resize(image.rows);
    int &first = share.panel_first[n] = image.rows, &end = share.panel_end[n] = 0, latest = 0;
    for (int q = 0; q < image.rows; ++q) {
      double low = 1e9, high = -1e9;
      for (int set = 0; set < problem.sets; ++set) {
        const Line line(problem.rays_from_panels + (set * problem.panels + n) * 9, q);
        const double right = image.width - 0.5, top = line.y(-0.5), bottom = line.y(right);
        const double run = std::abs(line.x(right) - line.x(-0.5));
        const double beside = 2 * std::abs(bottom - top) / std::max(run, 1.0);  // two pixels further along the line
        low = std::min({low, top - beside, bottom - beside}), high = std::max({high, top + beside, bottom + beside});
      }
      since[q] = int(std::clamp(std::floor(low), 0.0, height - 1.0));
      until[q] = latest = std::max(latest, int(std::clamp(std::floor(high) + 1, 0.0, height - 1.0)));
      share.rows = std::max(share.rows, latest - since[q] + 2);
      const bool mine = (latest >= share.first || part == 0) && (latest < share.end || part == parts - 1);
      if (mine) first = std::min(first, q), end = q + 1, begin = std::min(begin, since[q]);
    }
    for (int q = image.rows - 2; q >= 0; --q) since[q] = std::min(since[q], since[q + 1]);
    // Rays between two rows see both: phasors are there from the row before's first ray to the next one's last.
    held[n] = 2;
    for (int q = 0, oldest = 0; q < image.rows; held[n] = std::max(held[n], int64_t(++q - oldest) + 2))
      while (oldest < q && until[oldest + 1] < since[std::max(q - 1, 0)]) ++oldest;
    total += phasors ? 2 * held[n] * (image.width * problem.channels + LANES) : 0;
  }
  share.first = begin;
  share.stride = int64_t(problem.width) * problem.channels + 2 * LANES;
  share.plane = share.stride * share.rows;
  const int64_t rings = problem.sets * fields * share.plane + 2 * LANES;
  memory.resize(size_t(rings + total + 2 * LANES));
  share.ring = memory.data();
  int16_t *at = share.ring + rings;
  for (int n = 0; phasors && n < problem.panels; ++n)
    for (Image *image : {share.cosine + n, share.sine + n}) {
      const Image &like = problem.panel[n].ahead;
      *image = {at, int64_t(like.width) * problem.channels + LANES, like.rows, like.width, int32_t(held[n])};
      at += image->stride * held[n];
    }
  return share;
}

// Row q of a panel as cosine and sine of pi times what it shows.
INLINE void to_phasors(const Problem &problem, const Share &share, int n, int q) {
  const int16_t *row = problem.panel[n].ahead.row(q);
  int16_t *cosine = const_cast<int16_t *>(share.cosine[n].row(q)), *sine = const_cast<int16_t *>(share.sine[n].row(q));
  const int count = problem.panel[n].ahead.width * problem.channels;
  VECTORISED for (int k = 0; k < count; ++k) {
    const float t = (float(row[k]) - FULL / 2) * (PI / FULL), y = t * t;  // series about the middle of the range
    const float s = ((((-1.0f / 39916800 * y + 1.0f / 362880) * y - 1.0f / 5040) * y + 1.0f / 120) * y - 1.0f / 6) * y + 1;
    const float c = (((1.0f / 479001600 * y - 1.0f / 3628800) * y + 1.0f / 40320) * y - 1.0f / 720) * y + 1.0f / 24;
    cosine[k] = rounded(UNIT * std::clamp(-s * t, -1.0f, 1.0f));
    sine[k] = rounded(UNIT * std::clamp((c * y - 0.5f) * y + 1, -1.0f, 1.0f));
  }
}

INLINE void clear_beside(const Problem &problem, const Share &share, int set, int r, Span span) {
  const int C = problem.channels;
  for (int f = 0; f < share.fields; ++f) {
    int16_t *row = share.row(set, f, r);
    std::memset(row, 0, size_t(span.first) * C * sizeof *row);
    std::memset(row + span.last * C, 0, size_t(share.stride - span.last * C) * sizeof *row);
  }
}

// Row r of a set of rays: the squared slope, and for every panel the error times the other panels' phasors.
template <int C, int N>
INLINE void compare(const Problem &problem, const Share &share, int set, int r, Work &work) {
  Line lines[N];
  Span span{0, problem.width};
  for (int n = 0; n < N; ++n) {
    lines[n] = Line(problem.panels_from_rays + (set * N + n) * 9, r);
    span = common(span, inside(lines[n], problem.width, problem.panel[n].ahead, NEAR_PX));
  }
  const float row_taper = problem.row_taper[r] * UNIT;
  int tile = TILE_PX;
  for (const Line &line : lines) tile = std::min(tile, tile_px(line, span));
  for (int u = span.first; u < span.last; u += tile) {
    const int end = std::min(u + tile, span.last), count = (end - u) * C;
    for (int n = 0; n < N; ++n) {
      const Image phasor[2] = {share.cosine[n], share.sine[n]};
      sample<2, C>(phasor, lines[n], u, end, work, work.tile + 2 * n);
    }
    const int64_t at = int64_t(u) * C;
    const uint8_t *target = problem.targets[set % 2] + int64_t(r) * problem.width * C + at;
    const float *taper = problem.column_taper + at;
    int16_t *out[1 + 2 * N];
    for (int f = 0; f < 1 + 2 * N; ++f) out[f] = share.row(set, f, r) + at;
    for (int e = 0; e < count; e += LANES)
      VECTORISED for (int k = e; k < e + LANES; ++k) {
        float re[N], im[N], before_re[N + 1], before_im[N + 1], after_re[N + 1], after_im[N + 1];
        before_re[0] = after_re[N] = 1, before_im[0] = after_im[N] = 0;
        for (int n = 0; n < N; ++n) {
          re[n] = work.tile[2 * n][k] * (1 / UNIT), im[n] = work.tile[2 * n + 1][k] * (1 / UNIT);
          before_re[n + 1] = before_re[n] * re[n] - before_im[n] * im[n];
          before_im[n + 1] = before_re[n] * im[n] + before_im[n] * re[n];
        }
        for (int n = N - 1; n >= 0; --n) {
          after_re[n] = after_re[n + 1] * re[n] - after_im[n + 1] * im[n];
          after_im[n] = after_re[n + 1] * im[n] + after_im[n + 1] * re[n];
        }
        const float seen = 0.5f - 0.5f * before_re[N], slope = before_im[N];
        const float error = (seen - float(target[k]) * (1.0f / 255)) * (taper[k] * row_taper);
        out[0][k] = rounded(slope * slope * UNIT);
        for (int n = 0; n < N; ++n) {
          out[1 + 2 * n][k] = rounded(error * (before_re[n] * after_re[n + 1] - before_im[n] * after_im[n + 1]));
          out[2 + 2 * n][k] = rounded(error * (before_re[n] * after_im[n + 1] + before_im[n] * after_re[n + 1]));
        }
      }
  }
  clear_beside(problem, share, set, r, span);
}

// What F fields of all sets (four at most, whose sum fits) come to at pixels of a panel's row, into work.sum.
template <int F, int C>
INLINE void gather(const Problem &problem, const Share &share, const int *fields, int n, int q, Span tile, Work &work) {
  const int width = problem.panel[n].ahead.width;
  for (int f = 0; f < F; ++f) std::memset(work.sum[f], 0, sizeof work.sum[f]);
  for (int set = 0; set < problem.sets; ++set) {
    const Line line(problem.rays_from_panels + (set * problem.panels + n) * 9, q);
    Image images[F];
    for (int f = 0; f < F; ++f) images[f] = share.image(problem, set, fields[f]);
    const Span span = common(tile, inside(line, width, images[0], 0));
    if (span.first == span.last) continue;
    for (int u = span.first, length = tile_px(line, span); u < span.last; u += length) {
      const int end = std::min(u + length, span.last), count = (end - u) * C;
      sample<F, C>(images, line, u, end, work, work.tile);
      for (int f = 0; f < F; ++f) {
        std::memset(work.tile[f] + count, 0, LANES * sizeof *work.tile[f]);
        int16_t *sum = work.sum[f] + (u - tile.first) * C;
        for (int e = 0; e < count; e += LANES)
          VECTORISED for (int k = e; k < e + LANES; ++k) sum[k] = int16_t(sum[k] + work.tile[f][k]);
      }
    }
  }
}

// Row q of a panel, by (L5).
template <int C, int N>
INLINE void move(const Problem &problem, const Share &share, int n, int q, Work &work) {
  const Panel &panel = problem.panel[n];
  const int fields[3] = {0, 1 + 2 * n, 2 + 2 * n};
  const float least = problem.floor * float(problem.sets) * UNIT, size = problem.size * FULL / (N * PI / 2) / UNIT;
  for (int u = 0; u < panel.ahead.width; u += TILE_PX) {
    const Span tile{u, std::min(u + TILE_PX, panel.ahead.width)};
    gather<3, C>(problem, share, fields, n, q, tile, work);
    const int64_t at = int64_t(u) * C, count = int64_t(tile.last - u) * C;
    const int16_t *cosine = share.cosine[n].row(q) + at, *sine = share.sine[n].row(q) + at, *ahead = panel.ahead.row(q) + at;
    int16_t *last = const_cast<int16_t *>(panel.last.row(q)) + at, *moved = const_cast<int16_t *>(panel.moved.row(q)) + at;
    for (int e = 0; e < count; e += LANES)
      VECTORISED for (int k = e; k < e + LANES; ++k) {
        const float gradient = float(sine[k]) * float(work.sum[1][k]) + float(cosine[k]) * float(work.sum[2][k]);
        const float change = size * gradient / std::max(float(work.sum[0][k]), least);
        const float now = std::min(std::max(float(ahead[k]) - change, 0.0f), FULL);
        moved[k] = rounded(now + problem.momentum * (now - float(last[k])));
        last[k] = rounded(now);
      }
  }
}

// Row r of a set of rays: the weight of a target, and that times what the other panels leave to the middle one.
template <int C>
INLINE void lack(const Problem &problem, const Share &share, int set, int r, Work &work) {
  const int middle = problem.panels / 2;
  const double *homographies = problem.panels_from_rays + set * problem.panels * 9;
  const Span span = inside(Line(homographies + middle * 9, r), problem.width, problem.panel[middle].last, 0);
  Span whole = span;  // rays that cross every panel
  for (int n = 0; n < problem.panels; ++n)
    whole = common(whole, inside(Line(homographies + n * 9, r), problem.width, problem.panel[n].last, 0));
  for (int u = span.first; u < span.last; u += TILE_PX) {
    const Span tile{u, std::min(u + TILE_PX, span.last)};
    const int count = (tile.last - u) * C;
    float sum[TILE] = {};
    for (int n = 0; n < problem.panels; ++n) {
      if (n == middle) continue;
      const Line line(homographies + n * 9, r);
      const Span seen = common(tile, inside(line, problem.width, problem.panel[n].last, 0));
      std::fill(work.tile[0], work.tile[0] + TILE, int16_t(problem.rest));
      for (int v = seen.first, length = tile_px(line, seen); v < seen.last; v += length) {
        const int end = std::min(v + length, seen.last);
        sample<1, C>(&problem.panel[n].last, line, v, end, work, work.tile + 1);
        std::memcpy(work.tile[0] + (v - u) * C, work.tile[1], size_t(end - v) * C * sizeof(int16_t));
      }
      VECTORISED for (int k = 0; k < TILE; ++k) sum[k] += float(work.tile[0][k]);
    }
    const int64_t at = int64_t(u) * C;
    const uint8_t *target = problem.targets[set % 2] + int64_t(r) * problem.width * C + at;
    int16_t *weights = share.row(set, 0, r) + at, *wanted = share.row(set, 1, r) + at;
    float asked[TILE], weight[TILE];
    for (int k = 0; k < count; ++k) asked[k] = problem.table[2 * target[k]], weight[k] = problem.table[2 * target[k] + 1];
    const int begin = std::clamp((whole.first - u) * C, 0, count), end = std::clamp((whole.last - u) * C, begin, count);
    for (int k = 0; k < begin; ++k) weight[k] *= problem.missing;
    for (int k = end; k < count; ++k) weight[k] *= problem.missing;
    for (int e = 0; e < count; e += LANES)
      VECTORISED for (int k = e; k < e + LANES; ++k) {
        weights[k] = rounded(weight[k] * UNIT);
        wanted[k] = rounded(std::min(std::max(asked[k] - sum[k], -FULL), 2 * FULL) * weight[k] * 0.5f);
      }
  }
  clear_beside(problem, share, set, r, span);
}

// Row q of the middle panel: the mean of what all rays through it lack.
template <int C>
INLINE void fill(const Problem &problem, const Share &share, int q, Work &work) {
  const int middle = problem.panels / 2, fields[2] = {0, 1};
  const Image &image = problem.panel[middle].last;
  for (int u = 0; u < image.width; u += TILE_PX) {
    const Span tile{u, std::min(u + TILE_PX, image.width)};
    gather<2, C>(problem, share, fields, middle, q, tile, work);
    int16_t *out = const_cast<int16_t *>(image.row(q)) + int64_t(u) * C;
    for (int k = 0; k < (tile.last - u) * C; ++k)
      if (work.sum[0][k] > 0) out[k] = rounded(std::clamp(2 * UNIT * float(work.sum[1][k]) / float(work.sum[0][k]), 0.0f, FULL));
  }
}

template <int C, int N>
INLINE void step_rows(const Problem &problem, const Share &share) {
  Work work{};
  int at[N], ready[N];  // the next row of a panel that moves, and that becomes phasors
  std::copy(share.panel_first, share.panel_first + N, at);
  for (int n = 0; n < N; ++n)
    ready[n] = std::max(0, int(std::lower_bound(share.until[n].begin(), share.until[n].end(), share.first) - share.until[n].begin()) - 1);
  for (int r = share.first; r < share.end; ++r) {
    for (int n = 0; n < N; ++n)
      for (const int rows = problem.panel[n].ahead.rows; ready[n] < rows && share.since[n][std::max(ready[n] - 1, 0)] <= r; ++ready[n])
        to_phasors(problem, share, n, ready[n]);
    for (int set = 0; set < problem.sets; ++set) compare<C, N>(problem, share, set, r, work);
    for (int n = 0; n < N; ++n)
      while (at[n] < share.panel_end[n] && share.until[n][at[n]] <= r) move<C, N>(problem, share, n, at[n]++, work);
  }
}

template <int C>
INLINE void close_rows(const Problem &problem, const Share &share) {
  Work work{};
  const int middle = problem.panels / 2;
  int q = share.panel_first[middle];
  for (int r = share.first; r < share.end; ++r) {
    for (int set = 0; set < problem.sets; ++set) lack<C>(problem, share, set, r, work);
    while (q < share.panel_end[middle] && share.until[middle][q] <= r) fill<C>(problem, share, q++, work);
  }
}

}  // namespace

// One of so many parts of a step, all of which may run at once; a panel's phasors are `ahead`'s.
FOR_EVERY_CPU void step(const Problem *problem, int part, int parts) {
  const Share share = share_of(*problem, part, parts, 1 + 2 * problem->panels, true);
  switch (problem->channels * 10 + problem->panels) {
    case 12: return step_rows<1, 2>(*problem, share);
    case 13: return step_rows<1, 3>(*problem, share);
    case 14: return step_rows<1, 4>(*problem, share);
    case 15: return step_rows<1, 5>(*problem, share);
    case 32: return step_rows<3, 2>(*problem, share);
    case 33: return step_rows<3, 3>(*problem, share);
    case 34: return step_rows<3, 4>(*problem, share);
    case 35: return step_rows<3, 5>(*problem, share);
  }
}

// One of so many parts of the middle panel's `last`: the best for the other panels' as they stand.
FOR_EVERY_CPU void close_middle(const Problem *problem, int part, int parts) {
  const Share share = share_of(*problem, part, parts, 2, false);
  if (problem->channels == 3) close_rows<3>(*problem, share);
  else close_rows<1>(*problem, share);
}

// Rows of a panel in 8-bit codes, opaque, into (rows, width) RGBA pixels.
FOR_EVERY_CPU void show(const Image *panel, int channels, uint32_t *pixels, int64_t stride, int first, int end) {
  for (int r = first; r < end; ++r) {
    const int16_t *row = panel->row(r);
    uint32_t *to = pixels + r * stride;
    if (channels == 1) {
      VECTORISED for (int u = 0; u < panel->width; ++u) to[u] = uint32_t((row[u] + 8) >> 4) * 0x10101u | 0xff000000u;
      continue;
    }
    VECTORISED for (int u = 0; u < panel->width; ++u) {
      const uint32_t red = uint32_t(row[3 * u] + 8) >> 4, green = uint32_t(row[3 * u + 1] + 8) >> 4;
      to[u] = red | green << 8 | (uint32_t(row[3 * u + 2] + 8) >> 4) << 16 | 0xff000000u;
    }
  }
}

extern "C" { extern const int32_t problem_bytes = sizeof(Problem); }
