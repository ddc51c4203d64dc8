// The compiled functions apart from the solver's: resampling, measuring light, and building outlines.
#pragma once

#include <vector>

#include "sampling.hpp"

constexpr double BEYOND = 1e-9;     // minimum argument for the logarithm; no column corresponds to smaller arguments
constexpr int16_t LARGEST = 8160;   // largest absolute value that can be sampled; rounded mixtures must stay within 8191

struct Columns {  // for column u, the homography applies to t = middle + (1 - exp(-bend (u - middle))) / bend
  double bend, middle;
  double to(double u) const { return bend == 0 ? u : middle - std::expm1(-bend * (u - middle)) / bend; }
  double from(double t) const { return bend == 0 ? t : middle - std::log(std::max(1 - bend * (t - middle), BEYOND)) / bend; }
};

struct Warp {
  double image_from_raster[9];
  Columns image, raster;
  double reach_px;  // how far outwards the image's edge is repeated; at most EDGE_PX - 1
};

// Copy of an image whose elements are limited to +-LARGEST, and which may be read in whole vectors.
struct Source {
  std::vector<int16_t> memory;
  Image image;
  int channels;

  Source(const int16_t *pixels, int rows, int width, int channels);

  // Sample the result's rows from `begin` to `end` - 1 bilinearly. Pixels outside the image are set to `outside`.
  void warp(const Image &result, const Warp &by, int outside, int begin, int end) const;
};

constexpr int TABLE_STEPS = 16;  // table entries per code value for bilinearly sampled rays

struct View {
  const uint8_t *layers;  // (panels, height, width, components)
  int32_t panels, height, width, components;
  const float *target;  // (rows, columns, 3) intensities
  int32_t rows, columns;
  const double *centre_from_image;   // (3, 3) homography from picture pixels to centre-panel pixels
  const double *panels_from_centre;  // (points, panels, 3, 3) homographies from the centre panel to each panel
  const double *toward;              // (3) vector whose product with (u, v, 1) is negative for rays towards the panels
  const float *table;                // intensity for each sum of codes; sums are rounded to an index
  int64_t first_ray;                 // number of the first ray
  // points: number of points on the pupil. rays: rays along a pixel's side in each set, or 0 for a single ray, sampled
  // bilinearly. step: only every step-th pixel in every step-th row is measured.
  int32_t points, rays, step;
};

struct ErrorSum {
  double total;
  int64_t counted;
};

// Sum the products of the two ray sets' errors over every step-th row from `first` to `end` - 1, and count the terms.
ErrorSum squared_error(const View &view, int first, int end);

constexpr int VERTEX = 12;     // floats per vertex: position (3), attributes
constexpr int CORNER = 5 + 9;  // floats per corner of a ramp: clip coordinates (4), coverage, attributes

struct OutlinedPart {
  const float *vertices;  // (v, VERTEX)
  const int32_t *faces;   // (edges, 2) the faces at each edge; the second is -1 at a border
  const int32_t *ends;    // (edges, 2, 2) each face's vertices at the edge's ends
  const int32_t *apex;    // (edges, 2) each face's third vertex
  const double *normals;  // (triangles, 3)
  const double *heights;  // (triangles); a face is visible from an eye if eye . normal > height
  int edges, triangles;
};

// Write the ramps (4 corners each) along a part's outline, and return how many there are; at most one for each edge.
int outline_ramps(const OutlinedPart &part, const double *eye, const double *clip_from_part, double width_px, double height_px, double ramp_px, float *ramps);
