// A stack's panels, the rays through them, and the solver's operations on both.
#pragma once

#include <array>
#include <cstdlib>
#include <memory>
#include <utility>
#include <vector>

#include "sampling.hpp"

constexpr int MAX_SETS = 16;       // ray sets
constexpr int MAX_SIDE = 1 << 16;  // rows or columns of a panel or a picture
constexpr int MARGIN = 8 * LANES;  // elements after a panel's row, which whole vectors may reach

typedef std::pair<int, int> Size;  // rows, columns

// The panels' values between steps, in sixteenths of a code. Each panel's box starts at the first row and column.
struct Panels {
  struct Free {
    void operator()(void *memory) const { std::free(memory); }
  };
  struct Roles {
    int ahead, last, moved, before;  // numbers of buffers (`Panel`)
  };

  const int count, rows, columns, channels;
  int64_t stride;  // elements from row to row
  std::unique_ptr<int16_t[], Free> buffers[3];
  int last = 0, ahead = 1, moved = 2;
  bool starts = true;  // the next step has no momentum yet

  Panels(int count, int rows, int columns, int channels);

  int16_t *row(int buffer, int n, int r) const { return buffers[buffer].get() + (int64_t(n) * (rows + 1) + r) * stride; }

  // Rays may still read a row after it has been updated. The first step reads `last`, so it writes to other memory.
  Roles roles() const { return starts ? Roles{last, ahead, moved, last} : Roles{ahead, last, moved, last}; }

  // Exchange the buffers' roles after a step.
  void advance() {
    const Roles was = roles();
    last = was.last, ahead = was.moved, moved = was.ahead, starts = false;
  }
};

// A view's picture with 1 or 3 channels. Its last rows are copies, because they may be read in whole vectors.
struct Target {
  const uint8_t *pixels;
  int64_t stride, bytes;  // from row to row, and in a row
  int copied;             // number of the first row that is a copy
  std::vector<uint8_t> copies;

  Target(const uint8_t *pixels, int64_t stride, int64_t bytes, int rows) : pixels(pixels), stride(stride), bytes(bytes) {
    copied = rows - 1;
    while (copied > 0 && (rows - copied) * stride < LANES) --copied;
    for (int r = copied; r < rows; ++r) copies.insert(copies.end(), pixels + r * stride, pixels + r * stride + bytes);
    copies.resize(copies.size() + 2 * LANES);
  }
  const uint8_t *row(int r) const { return r < copied ? pixels + r * stride : copies.data() + (r - copied) * bytes; }
};

// The rays of one solution: targets and weights.
struct Rays {
  std::vector<Target> targets;        // for each view
  int rows, width, channels;          // size of the pictures
  std::vector<int16_t> column_taper;  // (width, channels) weights for the rays' errors; 32767 stands for 1
  std::vector<int16_t> row_taper;     // (rows) further weights
  std::array<int32_t, 256> table;     // for each target code, the sum of panel values plus 65536 times the weight
  float rest, missing;  // for close_middle: value outside the panels, and weight for rays that miss a panel
};

struct RaySet {
  int view, turn;
};

struct Panel {
  Image ahead;   // values with momentum, used to evaluate the rays
  Image moved;   // values with momentum after the step
  Image before;  // values without momentum
  Image last;    // values without momentum after the step; the same image as `before`, except in the first step, where
                 // `before` is `ahead`
};

struct Problem {
  std::shared_ptr<const Rays> rays;
  int panels, sets, channels;
  int height, width;  // size of a set
  int turns;          // sets take turns from one picture row to the next: row r of a set is picture row r * turns + turn
  std::vector<RaySet> ray_set;
  std::vector<double> panels_from_rays;  // (sets, panels, 3, 3) homographies from a set's rays to panel pixels
  std::vector<double> rays_from_panels;  // (sets, panels, 3, 3) inverses of these homographies
  Panel panel[MAX_PANELS];
  std::vector<bool> grey;  // for each panel, true if it has one value for all channels (no colour filters)

  // Throws std::invalid_argument if anything does not fit together. The panels must outlive the problem. `closing` is true
  // for `close_middle`, and false for a step.
  Problem(const Panels &panels, bool closing, std::shared_ptr<const Rays> rays, std::vector<Size> boxes, std::vector<double> panels_from_rays,
          std::vector<double> rays_from_panels, std::vector<RaySet> ray_set, int turns, std::vector<bool> grey);

  int row(int set, int r) const { return r * turns + ray_set[set].turn; }
  const uint8_t *target(int set, int r, int64_t at) const { return rays->targets[ray_set[set].view].row(row(set, r)) + at; }
  // Return how often to halve what is summed over the sets, so that the sums fit in 16 bits. Four squared slopes, each
  // at most 7830, or four residuals fit.
  int halvings() const { return sets <= 4 ? 0 : sets <= 8 ? 1 : 2; }
};

struct Update {
  float size, momentum, floor;
};

// Run part number `part` of a step divided into `parts` independent parts.
void step(const Problem &problem, const Update &update, int part, int parts);

// Solve the middle panel (`last`) with the other panels held fixed, in as many parts.
void close_middle(const Problem &problem, int part, int parts);

// Convert `count` pixels of a panel's row to opaque RGBA pixels with 8-bit codes.
void show(const int16_t *row, int channels, uint32_t *pixels, int count);
