// What the processor draws on the panels' screens. Pixels have four bytes, in the order RGBA in pictures and BGRX on the
// screen. Positions in pictures count from the centre of the top left pixel, positions on the screen and the panel from
// their corners. The panel's pixels are turned like the screen's, and coincide with them unless `registered`.
#pragma once

#include <array>

#include "sampling.hpp"

constexpr int CURVE = 1024;  // entries of a grey curve for each channel, indexed by quarters of a code

struct ScaleShift {
  float scale_u, scale_v, shift_u, shift_v;
};

struct Shown {
  const uint8_t *source;  // picture to sample; positions outside it are moved to its edge
  int64_t source_stride;  // bytes from row to row, as are the other strides
  uint8_t *screen;        // picture to draw
  int64_t screen_stride;
  const uint8_t *flat;  // picture of the screen's size to mix in, or null
  int64_t flat_stride;
  const uint32_t *curve;  // (3, CURVE) the screen's pixels with one byte each, blue, green and red; or null
  const float *relief;    // (relief_rows, relief_columns), or null
  int32_t source_rows, source_columns, rows, columns, relief_rows, relief_columns, panel_rows, panel_columns;
  ScaleShift source_from_panel;
  ScaleShift relief_from_screen;  // from the panel's pixels if `registered`
  ScaleShift push;                // displacement, in the source's pixels, by a relief of 1, from positions on the panel
  bool registered;                // true if `panel_from_screen` applies
  float panel_from_screen[9];     // homography; outside the panel, the screen shows the value 0
  float flatness;                 // weight of `flat`
  int32_t every;  // 1: sample every pixel; 2: every other one of every other row, and average between; not with `flat`
};

// Draw pictures on several threads with the caller's priority. Each thread draws the same share of every picture's rows.
void draw_panels(const Shown *shown, int count, int threads);

// Copy a turned picture into the middle of one that has a border. The turned picture's next row and next column are
// `row_step` and `column_step` bytes away. Return the box of the pixels that differ from the border in colour: its left,
// top, right and bottom edge in the framed picture. Without a border, the box is meaningless. The innermost `extended`
// pixels of the border, at most one, repeat the picture's edge.
std::array<int, 4> frame_picture(const uint8_t *turned, int64_t row_step, int64_t column_step, int rows, int columns, uint8_t *framed, int border_px, int extended);
