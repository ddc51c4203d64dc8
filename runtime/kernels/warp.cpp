// Resample an image to another raster through a homography. The image's and the raster's columns may be unevenly spaced
// (ColumnLaw in runtime/model/chain.py).
#include "loops.hpp"

namespace {

constexpr int BENT_TILE_PX = 64;   // maximum length of a tile with unevenly spaced columns, for a close enough parabola
constexpr int SOURCE_PX = 480;     // maximum width of a tile's source; columns are wide at the end of a column law

struct WarpedLine {
  Line line;  // maps evenly spaced columns (t)
  Columns image, raster;
  double t(double u) const { return raster.to(u + 0.5) - 0.5; }
  double x(double u) const { return image.from(line.x(t(u)) + 0.5) - 0.5; }
  double y(double u) const { return line.y(t(u)); }
};

// Return the pixels on a line that are inside an image or at most reach_px outside it.
INLINE Span reaches(const WarpedLine &at, int count, const Image &image, double reach_px) {
  const Line &line = at.line;
  const double left = at.image.to(-reach_px), right = at.image.to(image.width + reach_px), below = image.rows + reach_px;
  double low = at.t(0), high = at.t(count - 1);
  at_least_zero(line.wu, line.w0 - BEYOND, low, high);
  at_least_zero(line.xu - left * line.wu, line.x0 - left * line.w0, low, high);
  at_least_zero(right * line.wu - line.xu, right * line.w0 - line.x0, low, high);
  at_least_zero(line.yu + reach_px * line.wu, line.y0 + reach_px * line.w0, low, high);
  at_least_zero(below * line.wu - line.yu, below * line.w0 - line.y0, low, high);
  if (!(high >= low)) return {0, 0};
  const double first = at.raster.from(low + 0.5) - 0.5, last = at.raster.from(high + 0.5) - 0.5;
  const Span span{int(limited(std::ceil(first - 1e-6), 0, count)), int(limited(std::floor(last + 1e-6) + 1, 0, count))};
  return span.first < span.last ? span : Span{0, 0};
}

template <int C>
INLINE void warp_rows(const Image &image, const Image &result, const Warp &warp, int outside, int begin, int end_row) {
  Work work{};
  const bool bent = warp.image.bend != 0 || warp.raster.bend != 0;
  for (int r = begin; r < end_row; ++r) {
    const WarpedLine line{Line(warp.image_from_raster, r), warp.image, warp.raster};
    const Span span = reaches(line, result.width, image, warp.reach_px);
    int16_t *row = result.data + int64_t(r) * result.stride;
    std::fill(row, row + int64_t(span.first) * C, int16_t(outside));
    std::fill(row + int64_t(span.last) * C, row + int64_t(result.width) * C, int16_t(outside));
    if (span.first == span.last) continue;
    const int length = std::min(tile_px(line.line, span), bent ? BENT_TILE_PX : TILE_PX);
    for (int u = span.first, end; u < span.last; u = end) {
      end = std::min(u + length, span.last);
      const double x = line.x(u);
      for (double across; end - u > 1 && !((across = line.x(end - 1) - x) >= 0 && across < SOURCE_PX);) end -= (end - u) / 2;
      sample<1, C>(&image, line, u, end, work, work.tile);
      std::memcpy(row + int64_t(u) * C, work.tile[0], size_t(end - u) * C * sizeof(int16_t));
    }
  }
}

INLINE void warp_image_any(const Image &image, int channels, const Image &result, const Warp &by, int outside, int begin, int end) {
  if (channels == 3) warp_rows<3>(image, result, by, outside, begin, end);
  else warp_rows<1>(image, result, by, outside, begin, end);
}

}  // namespace

FOR_EVERY_LEVEL(warp_image, void, (const Image &image, int channels, const Image &result, const Warp &by, int outside, int begin, int end), (image, channels, result, by, outside, begin, end))

Source::Source(const int16_t *pixels, int rows, int width, int channels) : channels(channels) {
  require(rows >= 1 && width >= 1 && (channels == 1 || channels == 3), "an image must have rows, columns and 1 or 3 channels");
  const int64_t elements = int64_t(rows) * width * channels;
  memory.resize(size_t(elements + 2 * LANES));
  for (int64_t k = 0; k < elements; ++k) memory[k] = std::min(std::max(pixels[k], int16_t(-LARGEST)), LARGEST);
  image = {memory.data(), int64_t(width) * channels, rows, width, rows};
}

void Source::warp(const Image &result, const Warp &by, int outside, int begin, int end) const {
  const double law[] = {by.image.bend, by.image.middle, by.raster.bend, by.raster.middle};
  require(usable(by.image_from_raster, 1), "a homography is not finite");
  require(std::all_of(law, law + 4, [](double x) { return std::abs(x) < 1e9; }), "a column law is not finite");
  require(by.reach_px > -1e9 && by.reach_px <= EDGE_PX - 1, "an image's edge can be repeated over at most 3 pixels");
  require(0 <= begin && begin <= end && end <= result.rows, "there are no such rows");
  warp_image(image, channels, result, by, outside, begin, end);
}
