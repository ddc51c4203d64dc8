// Find the edges that are on a part's outline, and build a ramp along each (runtime/content/fringe.py).
#include <vector>

#include "sampling.hpp"

namespace {

constexpr int VERTEX = 12;         // floats per vertex: position (3), attributes
constexpr int CORNER = 5 + 9;      // floats per corner of a ramp: clip coordinates (4), coverage, attributes
constexpr double NEAREST = 1e-6;   // smallest clip coordinate w of an edge that gets a ramp
constexpr double SHORTEST = 1e-3;  // length in pixels of the shortest edge that has a direction

struct OutlinedPart {
  const float *vertices;   // (v, VERTEX)
  const int32_t *faces;    // (edges, 2) the faces at each edge; the second is -1 at a border
  const int32_t *ends;     // (edges, 2, 2) each face's vertices at the edge's ends
  const int32_t *apex;     // (edges, 2) each face's third vertex
  const double *normals;   // (triangles, 3)
  const double *heights;   // (triangles); a face is visible from an eye if eye · normal > height
  int32_t edges, triangles;
  double eye[3], clip_from_part[16];
};

struct Clip {
  double x, y, z, w;
};

INLINE Clip projected(const double *m, const float *p) {
  const auto row = [&](int k) { return m[4 * k] * p[0] + m[4 * k + 1] * p[1] + m[4 * k + 2] * p[2] + m[4 * k + 3]; };
  return {row(0), row(1), row(2), row(3)};
}

INLINE void write_corner(float *corner, Clip at, float coverage, const float *vertex) {
  corner[0] = float(at.x), corner[1] = float(at.y), corner[2] = float(at.z), corner[3] = float(at.w);
  corner[4] = coverage;
  std::memcpy(corner + 5, vertex + 3, (CORNER - 5) * sizeof(float));
}

// Write the ramp along an edge, given its ends and its visible face's third vertex. Return false if it gets none.
INLINE bool write_ramp(const OutlinedPart &part, const float *const vertex[3], double half_width_px, double half_height_px, double ramp_px, float *ramp) {
  Clip clip[3];
  double u[3], v[3];
  for (int k = 0; k < 3; ++k) {
    clip[k] = projected(part.clip_from_part, vertex[k]);
    if (!(clip[k].w > NEAREST)) return false;
    u[k] = clip[k].x / clip[k].w * half_width_px, v[k] = clip[k].y / clip[k].w * half_height_px;
  }
  const double along_u = u[1] - u[0], along_v = v[1] - v[0], length = std::hypot(along_u, along_v);
  if (!(length > SHORTEST)) return false;
  const bool apex_is_left = (v[2] - v[0]) * along_u - (u[2] - u[0]) * along_v > 0;
  const double outward = (apex_is_left ? -ramp_px : ramp_px) / length;
  for (int end = 0; end < 2; ++end) {
    Clip outside = clip[end];
    outside.x -= along_v * outward / half_width_px * outside.w, outside.y += along_u * outward / half_height_px * outside.w;
    write_corner(ramp + end * CORNER, clip[end], 1.0f, vertex[end]);
    write_corner(ramp + (2 + end) * CORNER, outside, 0.0f, vertex[end]);
  }
  return true;
}

}  // namespace

// Write the ramps (4 corners each) of parts in a given order, and how many each of them has.
extern "C" void outline_ramps(const OutlinedPart *parts, const int32_t *order, int count, double width_px, double height_px, double ramp_px, float *ramps, int32_t *counts) {
  std::vector<uint8_t> facing;
  for (int k = 0; k < count; ++k) {
    const OutlinedPart &part = parts[order[k]];
    facing.resize(part.triangles);
    for (int t = 0; t < part.triangles; ++t) {
      const double *n = part.normals + 3 * t;
      facing[t] = n[0] * part.eye[0] + n[1] * part.eye[1] + n[2] * part.eye[2] > part.heights[t];
    }
    counts[k] = 0;
    for (int e = 0; e < part.edges; ++e) {
      const int32_t one = part.faces[2 * e], two = part.faces[2 * e + 1];
      if (two >= 0 && facing[one] == facing[two]) continue;
      const int which = two < 0 || facing[one] ? 0 : 1;
      const int32_t *ends = part.ends + 4 * e + 2 * which;
      const float *const vertex[3] = {part.vertices + VERTEX * ends[0], part.vertices + VERTEX * ends[1],
                                      part.vertices + VERTEX * part.apex[2 * e + which]};
      if (write_ramp(part, vertex, width_px / 2, height_px / 2, ramp_px, ramps)) ramps += 4 * CORNER, ++counts[k];
    }
  }
}

extern "C" { extern const int32_t outlined_part_bytes = sizeof(OutlinedPart); }
