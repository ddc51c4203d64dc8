// Bilinear sampling of images along raster rows, through a homography. Used by all the kernels.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <stdexcept>

// Define a function that calls NAME_any, which must be INLINE. It is compiled for three levels of x86-64 processors, and
// calls choose the one for `processor_level`. With ONE_LEVEL, it is only compiled for the compiler's options.
#if !defined(ONE_LEVEL) && defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define EVERY_LEVEL 1
#define FOR_EVERY_LEVEL(NAME, RESULT, PARAMETERS, ARGUMENTS) \
  __attribute__((target("arch=x86-64-v4"))) static RESULT NAME##_v4 PARAMETERS { return NAME##_any ARGUMENTS; } \
  __attribute__((target("arch=x86-64-v3"))) static RESULT NAME##_v3 PARAMETERS { return NAME##_any ARGUMENTS; } \
  static RESULT NAME##_v1 PARAMETERS { return NAME##_any ARGUMENTS; } \
  RESULT NAME PARAMETERS { \
    return processor_level == 4 ? NAME##_v4 ARGUMENTS : processor_level == 3 ? NAME##_v3 ARGUMENTS : NAME##_v1 ARGUMENTS; \
  }
#else
#define EVERY_LEVEL 0
#define FOR_EVERY_LEVEL(NAME, RESULT, PARAMETERS, ARGUMENTS) \
  RESULT NAME PARAMETERS { return NAME##_any ARGUMENTS; }
#endif
#define INLINE static inline __attribute__((always_inline))
#define VECTORISED _Pragma("GCC ivdep")

extern int processor_level;  // 4 (AVX-512), 3 (AVX2) or 1

constexpr int LANES = 32;     // elements per vector in the loops; the compiler splits vectors as the processor requires
constexpr int TILE_PX = 256;  // pixels in a row that are sampled together; their data fits in the first-level cache
constexpr int EDGE_PX = 4;    // maximum distance, in pixels, that an image may be sampled beyond its edge
constexpr int MAX_PANELS = 6;
constexpr int MAX_CHANNELS = 3;
constexpr int TILE = TILE_PX * MAX_CHANNELS + 2 * LANES;  // elements, including some that may be overwritten at the end
constexpr int SOURCE = 2 * TILE + MAX_CHANNELS * LANES;   // elements
constexpr int FIELDS = 2;  // maximum number of images sampled together
constexpr float WEIGHT_UNIT = 16384;  // an interpolation weight of 1 in fixed point

// Image of 16-bit elements with interleaved channels. Reads are in whole vectors, which may extend past the end of a
// row.
struct Image {
  int16_t *data;
  int64_t stride;  // distance between rows in elements
  int32_t rows, width, ring;  // row r is stored at index r % ring
  const int16_t *row(int r) const { return data + int64_t(r % ring) * stride; }
};

// Throw std::invalid_argument, which is a ValueError in Python, unless a condition holds.
inline void require(bool condition, const char *message) {
  if (!condition) throw std::invalid_argument(message);
}

// Return true if homographies are finite, and small enough for products of a few entries and pixels to be finite.
inline bool usable(const double *homographies, int64_t count) {
  return std::all_of(homographies, homographies + count * 9, [](double entry) { return std::abs(entry) < 1e30; });
}

struct Ramp {  // each element's pixel index, for images with one or three channels
  int16_t one_channel[LANES + MAX_CHANNELS] = {}, three_channels[LANES + MAX_CHANNELS] = {};
  constexpr Ramp() {
    for (int e = 0; e < LANES + MAX_CHANNELS; ++e) one_channel[e] = int16_t(e), three_channels[e] = int16_t(e / 3);
  }
};
constexpr Ramp RAMP;

// A raster row, mapped by a homography. x and y return the image position of the pixel with index u, with pixel centres
// at integers.
struct Line {
  double x0, xu, y0, yu, w0, wu;
  Line() = default;
  Line(const double *homography, int row) {
    const double *m = homography, v = row + 0.5;
    xu = m[0], x0 = m[0] * 0.5 + m[1] * v + m[2];
    yu = m[3], y0 = m[3] * 0.5 + m[4] * v + m[5];
    wu = m[6], w0 = m[6] * 0.5 + m[7] * v + m[8];
  }
  double x(double u) const { return (x0 + xu * u) / (w0 + wu * u) - 0.5; }
  double y(double u) const { return (y0 + yu * u) / (w0 + wu * u) - 0.5; }
};

struct Span {
  int first, last;  // pixels from first to last - 1
};

INLINE Span common(Span a, Span b) {
  const Span both{std::max(a.first, b.first), std::min(a.last, b.last)};
  return both.first < both.last ? both : Span{0, 0};
}

INLINE void at_least_zero(double slope, double offset, double &low, double &high) {
  if (slope > 0) low = std::max(low, -offset / slope);
  else if (slope < 0) high = std::min(high, -offset / slope);
  else if (offset < 0) high = -1;
}

// Return the pixels in a row of `count` that are mapped to positions at least `near` pixels inside the image's edges.
INLINE Span inside(const Line &line, int count, const Image &image, double near) {
  constexpr double rounded = 1e-6;  // tolerance for rounding errors in positions on an edge
  const double right = image.width - near, below = image.rows - near;
  double low = 0, high = count - 1;
  at_least_zero(line.wu, line.w0 - 1e-9, low, high);
  at_least_zero(line.xu - near * line.wu, line.x0 - near * line.w0, low, high);
  at_least_zero(right * line.wu - line.xu, right * line.w0 - line.x0, low, high);
  at_least_zero(line.yu - near * line.wu, line.y0 - near * line.w0, low, high);
  at_least_zero(below * line.wu - line.yu, below * line.w0 - line.y0, low, high);
  if (!(high >= low - rounded)) return {0, 0};
  const Span span{int(std::ceil(low - rounded)), int(std::floor(high + rounded)) + 1};
  return span.first < span.last ? span : Span{0, 0};
}

INLINE int64_t whole_vectors(int64_t elements) { return (elements + LANES - 1) / LANES * LANES; }

INLINE int16_t rounded(float x) { return int16_t(int(std::nearbyintf(x))); }

// Return a·b/32768, rounded. Most processors compute it in a single instruction.
INLINE int16_t product(int16_t a, int16_t b) { return int16_t((((int32_t(a) * int32_t(b)) >> 14) + 1) >> 1); }

// Interpolate from a to b by `share`, in WEIGHT_UNIT: part_of returns the change, and mixed returns the interpolated
// value. a and b must be within ±8191, so that twice their difference fits in 16 bits.
INLINE int16_t part_of(int16_t a, int16_t b, int16_t share) { return product(int16_t(2 * (b - a)), share); }
INLINE int16_t mixed(int16_t a, int16_t b, int16_t share) { return int16_t(a + part_of(a, b, share)); }

struct alignas(2 * LANES) Work {
  int16_t source[FIELDS][SOURCE];
  int16_t tile[2 * MAX_PANELS][TILE];
  int16_t sum[TILE];
};

// Image positions of consecutive pixels on a line, and the image columns that must be read for them.
struct Stretch {
  double xs, xe, ys, ye;  // positions (x, y) of the first pixel (s) and the last pixel (e)
  int first, steps;       // first pixel, and number of steps from there to the last pixel
  bool on_pixels;         // true if the pixels coincide with consecutive image columns
  int s0, elements;       // first image column to read, and number of elements to read from there
};

// Return a value limited to a range. For NaN, return the lower limit.
INLINE double limited(double value, double low, double high) { return value > low ? (value < high ? value : high) : low; }

template <int C, typename AnyLine>
INLINE Stretch stretch_of(const Image &image, const AnyLine &line, int first, int last) {
  // The limits only matter where rounding has moved a pixel near the horizon out of the image.
  const auto x_of = [&](int u) { return limited(line.x(u), -EDGE_PX, image.width + EDGE_PX - 1.01); };
  const auto y_of = [&](int u) { return limited(line.y(u), -EDGE_PX, image.rows + EDGE_PX - 1.01); };
  const double xs = x_of(first), xe = x_of(last - 1), left = std::min(xs, xe), right = std::max(xs, xe);
  const int steps = last - 1 - first;
  const auto whole_px = [](double px) { return std::abs(px - std::nearbyint(px)) < 1e-6; };
  const bool on_pixels = xs >= 0 && xe < image.width && whole_px(xs) && std::abs(xe - xs - steps) < 1e-6 &&
                         std::abs(line.x(first + 0.5 * steps) - xs - 0.5 * steps) < 1e-6;
  const int s0 = on_pixels ? int(std::nearbyint(xs)) : std::clamp(int(std::floor(left)) - 1, 0, image.width - 1) / LANES * LANES;
  const int s1 = std::clamp(int(std::floor(right)) + 2, 0, image.width - 1);
  return {xs, xe, y_of(first), y_of(last - 1), first, steps, on_pixels, s0, (s1 - s0 + 1) * C};
}

// Return true if `mix_rows` and `mix_neighbours` can sample a stretch: its columns fit in the buffer, its rows do not run
// steeply, and positions between its ends lie between those of the ends. A single pixel always fits.
template <typename AnyLine>
INLINE bool fits(const AnyLine &line, const Stretch &along) {
  if (along.steps == 0) return true;
  const double across = along.xe - along.xs, down = std::abs(along.ye - along.ys), half = 0.5 * along.steps;
  if (along.elements > SOURCE - 4 * LANES) return false;
  if (!(down <= 0.5 || (std::abs(across) > 0.5 && down <= 2 * std::abs(across)))) return false;
  if (along.steps == 1) return true;
  const double sag = line.x(along.first + half) - 0.5 * (along.xs + along.xe);  // of the parabola, at its middle
  return std::abs(sag) < 0.25 || 4 * std::abs(sag) <= std::abs(across);
}

// Interpolate between the image rows above and below a stretch, and store the result for image f in to[f]. The stretch
// is divided into runs, and weights change linearly along each run.
template <int F, int C>
INLINE void mix_rows(const Image *images, const Stretch &along, int16_t *const (&to)[F]) {
  const Image &image = images[0];
  const int16_t *ramp = C == 1 ? RAMP.one_channel : RAMP.three_channels;
  const double slope = std::abs(along.xe - along.xs) > 0.5 ? (along.ye - along.ys) / (along.xe - along.xs) : 0, bottom = image.rows - 1;
  for (int at = 0, length; at < along.elements; at += length) {
    const double y = along.ys + (along.s0 + at / C - along.xs) * slope, within = std::clamp(y, 0.0, bottom);
    const int row = std::min(int(within), std::max(image.rows - 2, 0));
    double grows = y == within ? slope : 0, until = 1e6;  // growth of the weight per pixel; run length in pixels
    if (std::abs(slope) > 1e-7) {
      const double end = y < 0 ? (slope > 0 ? 0 : -1e9) : y > bottom ? (slope < 0 ? bottom : 1e9) : row + (slope > 0);
      until = std::min((end - y) / slope, 1e6);
    }
    length = std::min(along.elements - at, (int(until) + 1) * C);
    const double share = (within - row) * WEIGHT_UNIT;
    const int16_t step = rounded(float(grows * WEIGHT_UNIT));
    const int64_t from = int64_t(along.s0) * C + at;
    for (int e = 0; e < length; e += LANES) {
      const int px = e / C, phase = e - px * C;
      const int16_t begin = rounded(float(share + grows * WEIGHT_UNIT * px));
      int16_t weights[LANES];
      VECTORISED for (int k = 0; k < LANES; ++k) weights[k] = int16_t(begin + step * ramp[k + phase]);
      for (int f = 0; f < F; ++f) {
        const int16_t *upper = images[f].row(row) + from + e;
        const int16_t *lower = images[f].row(std::min(row + 1, image.rows - 1)) + from + e;
        int16_t *mix = to[f] + at + e;
        VECTORISED for (int k = 0; k < LANES; ++k) mix[k] = mixed(upper[k], lower[k], weights[k]);
      }
    }
  }
}

// Repeat the first and last pixels of interpolated rows beyond the ends of the rows (clamp to edge).
template <int C>
INLINE void clamp_ends(int16_t *source, int elements) {
  for (int beyond = 1; beyond <= EDGE_PX; ++beyond)
    for (int c = 0; c < C; ++c) {
      source[c - beyond * C] = source[c];
      source[elements + (beyond - 1) * C + c] = source[elements - C + c];
    }
}

// Parabola that approximates pixel positions, in units of 2^-32 pixels. Relative to the first column read, pixel k is
// at k + begin + drift·k + turn·k².
struct Parabola {
  int64_t begin, drift, turn;
  int at_once;  // elements processed together as a vector
};

template <int C, typename AnyLine>
INLINE Parabola parabola_of(const AnyLine &line, const Stretch &along) {
  const int steps = along.steps;
  const double half = 0.5 * steps, middle = steps > 1 ? line.x(along.first + half) : 0.5 * (along.xs + along.xe);
  const double bend = steps > 1 ? (along.xs + along.xe - 2 * middle) / (half * half) * 0.5 : 0;
  const double scale = steps > 0 ? (along.xe - along.xs) / steps - bend * steps : 1;  // scale at the first pixel
  // Make vectors as large as possible, while the positions gain less than three pixels on the line and the parabola
  // stays close to its chord. With one channel, the limit is two pixels, because rounding errors in the growing weight
  // accumulate over 32 pixels.
  constexpr double gains = C == 1 ? 1.9 : 2.9;
  const double most = std::max(std::abs(scale - 1), std::abs(scale - 1 + 2 * bend * steps));
  int at_once = LANES;
  for (int px; px = (at_once + C - 2) / C, at_once > 1 && (most * px > gains || std::abs(bend) * px * px > 0.008);) at_once /= 2;
  constexpr double one = 4294967296.0;
  return {int64_t((along.xs - along.s0) * one), int64_t((scale - 1) * one), int64_t(bend * one), at_once};
}

// Interpolate horizontally between neighbours in interpolated rows, one vector at a time. Source positions advance
// slightly faster or slower than the line's pixels, so each vector needs two to five neighbours.
template <int F, int C>
INLINE void mix_neighbours(const Parabola &by, int elements, const int16_t *const (&sources)[F], int16_t *const (&to)[F]) {
  const int16_t *ramp = C == 1 ? RAMP.one_channel : RAMP.three_channels;
  for (int e = 0; e < elements; e += by.at_once) {
    const int k = e / C, phase = e - k * C, px = (by.at_once - 1 + phase) / C;
    const int first_at = int((by.begin + k * (by.drift + by.turn * k)) >> 18);  // in WEIGHT_UNIT
    const int each = int((by.drift + by.turn * (2 * k + px) + (1 << 17)) >> 18), last_at = first_at + each * px;
    const int offset = std::min(first_at, last_at) >> 14, further = (std::max(first_at, last_at) >> 14) - offset;  // pixels
    const uint16_t share = uint16_t(first_at - offset * int(WEIGHT_UNIT));
    int16_t weights[4][LANES];  // weights of the differences between successive neighbours
    VECTORISED for (int i = 0; i < LANES; ++i) {
      constexpr uint16_t full = uint16_t(WEIGHT_UNIT);
      const uint16_t weight = uint16_t(share + uint16_t(each) * uint16_t(ramp[i + phase])), to_second = std::min(weight, full);
      const uint16_t rest = uint16_t(weight - to_second), to_third = std::min(rest, full);
      const uint16_t beyond = uint16_t(rest - to_third), to_fourth = std::min(beyond, full);
      weights[0][i] = int16_t(to_second), weights[1][i] = int16_t(to_third);
      weights[2][i] = int16_t(to_fourth), weights[3][i] = int16_t(beyond - to_fourth);
    }
    for (int f = 0; f < F; ++f) {
      const int16_t *source = sources[f] + (k + offset) * C + phase;
      int16_t *mix = to[f] + e;
      if (further == 0) VECTORISED for (int i = 0; i < LANES; ++i) mix[i] = mixed(source[i], source[i + C], weights[0][i]);
      else VECTORISED for (int i = 0; i < LANES; ++i)
        mix[i] = int16_t(mixed(source[i], source[i + C], weights[0][i]) + part_of(source[i + C], source[i + 2 * C], weights[1][i]));
      for (int n = 2; n <= further; ++n)
        VECTORISED for (int i = 0; i < LANES; ++i)
          mix[i] = int16_t(mix[i] + part_of(source[i + n * C], source[i + (n + 1) * C], weights[n][i]));
    }
  }
}

// Sample F images of equal shape at a line's pixels from `first` to `last` - 1. There may be at most TILE_PX pixels,
// and all of them must be `inside`. The samples of image f are stored in out[f], starting at element `begin_at`. Up to
// a vector and two pixels after the last sample may be overwritten, but nothing before the first.
template <int F, int C, typename AnyLine>
INLINE void sample(const Image *images, const AnyLine &line, int first, int last, Work &work, int16_t (*out)[TILE], int begin_at = 0) {
  for (int end; first < last; begin_at += (end - first) * C, first = end) {
    end = last;
    Stretch along = stretch_of<C>(images[0], line, first, end);
    while (!fits(line, along)) end -= (end - first) / 2, along = stretch_of<C>(images[0], line, first, end);
    int16_t *mixes[F], *to[F];  // if pixels coincide with columns, rows are interpolated directly into the output
    for (int f = 0; f < F; ++f) to[f] = out[f] + begin_at, mixes[f] = along.on_pixels ? to[f] : work.source[f] + LANES;
    mix_rows<F, C>(images, along, mixes);
    if (along.on_pixels) continue;
    for (int f = 0; f < F; ++f) clamp_ends<C>(mixes[f], along.elements);
    mix_neighbours<F, C>(parabola_of<C>(line, along), (along.steps + 1) * C, mixes, to);
  }
}

// Return the tile length for a line, in pixels. It is short enough to keep the parabola's error below 0.01 pixel and to
// make the source fit in its buffer.
INLINE int tile_px(const Line &line, Span span) {
  const double nearest = std::min(std::abs(line.w0 + line.wu * span.first), std::abs(line.w0 + line.wu * span.last));
  const double turn = std::max(std::abs(line.wu) / nearest, 1e-9);
  const double scale = std::max(std::abs(line.xu - line.wu * (line.x(span.first) + 0.5)),
                                std::abs(line.xu - line.wu * (line.x(span.last) + 0.5))) / nearest;
  const double bent = std::cbrt(0.2 / (turn * turn * std::max(scale, 1.0))), wide = scale > 1.8 ? 1.8 / scale : 1;
  return int(limited(std::min(bent, TILE_PX * wide), 4, TILE_PX));  // `sample` divides tiles further if it must
}
