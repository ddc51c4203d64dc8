// Squared error of an eye's view of the displayed layers, computed ray by ray for a range of rows
// (runtime/optics/light.py).
#include "loops.hpp"

namespace {

// Return the random bits for a ray's number (splitmix64). The lower 24 bits are used for the horizontal position within
// the pixel, the next 24 for the vertical position, and the upper 16 for the pupil point.
INLINE uint64_t random_bits(uint64_t ray) {
  uint64_t bits = ray * 0x9E3779B97F4A7C15u;
  bits = (bits ^ (bits >> 30)) * 0xBF58476D1CE4E5B9u;
  bits = (bits ^ (bits >> 27)) * 0x94D049BB133111EBu;
  return bits ^ (bits >> 31);
}

// Add the red, green and blue intensities along one ray to `seen`. Return false if the ray misses a panel.
INLINE bool see(const View &view, double u, double v, int point, float *seen) {
  if (!(view.toward[0] * u + view.toward[1] * v + view.toward[2] < 0)) return false;
  const double *c = view.centre_from_image, weight = 1 / (c[6] * u + c[7] * v + c[8]);
  const double a = (c[0] * u + c[1] * v + c[2]) * weight, b = (c[3] * u + c[4] * v + c[5]) * weight;
  float sums[3] = {0.5f, 0.5f, 0.5f};
  const int64_t plane = int64_t(view.height) * view.width * view.components;
  for (int n = 0; n < view.panels; ++n) {
    const double *m = view.panels_from_centre + (int64_t(point) * view.panels + n) * 9;
    const double w = 1 / (m[6] * a + m[7] * b + m[8]);
    const double x = (m[0] * a + m[1] * b + m[2]) * w, y = (m[3] * a + m[4] * b + m[5]) * w;
    if (!(0.5 < x && x < view.width - 0.5 && 0.5 < y && y < view.height - 0.5)) return false;
    const uint8_t *layer = view.layers + n * plane;
    if (view.rays) {
      const uint8_t *pixel = layer + (int64_t(y) * view.width + int64_t(x)) * view.components;
      for (int k = 0; k < 3; ++k) sums[k] += pixel[k];
      continue;
    }
    const int64_t row = int64_t(y - 0.5), column = int64_t(x - 0.5);
    const float down = float(y - 0.5 - double(row)), right = float(x - 0.5 - double(column));
    for (int corner = 0; corner < 4; ++corner) {
      const int below = corner > 1, to_right = corner & 1;
      const float part = (below ? down : 1 - down) * (to_right ? right : 1 - right) * TABLE_STEPS;
      const uint8_t *pixel = layer + ((row + below) * view.width + column + to_right) * view.components;
      for (int k = 0; k < 3; ++k) sums[k] += part * pixel[k];
    }
  }
  for (int k = 0; k < 3; ++k) seen[k] += view.table[int(sums[k])];
  return true;
}

// Sum the products of the two ray sets' errors over every step-th row from `first` to `end` - 1, and count the terms.
INLINE ErrorSum squared_error_any(const View &view, int first, int end) {
  const int in_set = std::max(view.rays * view.rays, 1), sets = view.rays ? 2 : 1, side = std::max(view.rays, 1);
  double total = 0;
  int64_t counted = 0;
  for (int row = first; row < end; row += view.step)
    for (int column = 0; column < view.columns; column += view.step) {
      float seen[2][3] = {};
      bool counts = true;
      const int64_t number = view.first_ray + (int64_t(row) * view.columns + column) * in_set * sets;
      for (int ray = 0; ray < in_set * sets && counts; ++ray) {
        double u = column + 0.5, v = row + 0.5;
        int point = 0;
        if (view.rays) {
          const uint64_t bits = random_bits(uint64_t(number + ray));
          const int stratum = ray % in_set;
          u = column + (stratum % side + double(bits & 0xFFFFFF) * 0x1p-24) / side;
          v = row + (stratum / side + double(bits >> 24 & 0xFFFFFF) * 0x1p-24) / side;
          point = int((bits >> 48) * uint64_t(view.points) >> 16);
        }
        counts = see(view, u, v, point, seen[ray / in_set]);
      }
      if (!counts) continue;
      const float *target = view.target + (int64_t(row) * view.columns + column) * 3;
      for (int k = 0; k < 3; ++k)
        total += (seen[0][k] / float(in_set) - target[k]) * (seen[sets - 1][k] / float(in_set) - target[k]);
      counted += 3;
    }
  return {total, counted};
}

}  // namespace

FOR_EVERY_LEVEL(squared_error, ErrorSum, (const View &view, int first, int end), (view, first, end))
