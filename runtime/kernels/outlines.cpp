// Find the edges that are on a part's outline, and build a ramp along each (runtime/content/fringe.py).
#include "loops.hpp"

namespace {

constexpr double NEAREST = 1e-6;   // smallest clip coordinate w of an edge that gets a ramp
constexpr double SHORTEST = 1e-3;  // length in pixels of the shortest edge that has a direction

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
INLINE bool write_ramp(const double *clip_from_part, const float *const vertex[3], double half_width_px, double half_height_px, double ramp_px, float *ramp) {
  Clip clip[3];
  double u[3], v[3];
  for (int k = 0; k < 3; ++k) {
    clip[k] = projected(clip_from_part, vertex[k]);
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

int outline_ramps(const OutlinedPart &part, const double *eye, const double *clip_from_part, double width_px, double height_px, double ramp_px, float *ramps) {
  std::vector<uint8_t> facing(part.triangles);
  for (int t = 0; t < part.triangles; ++t) {
    const double *n = part.normals + 3 * t;
    facing[t] = n[0] * eye[0] + n[1] * eye[1] + n[2] * eye[2] > part.heights[t];
  }
  int count = 0;
  for (int e = 0; e < part.edges; ++e) {
    const int32_t one = part.faces[2 * e], two = part.faces[2 * e + 1];
    if (two >= 0 && facing[one] == facing[two]) continue;
    const int which = two < 0 || facing[one] ? 0 : 1;
    const int32_t *ends = part.ends + 4 * e + 2 * which;
    const float *const vertex[3] = {part.vertices + VERTEX * ends[0], part.vertices + VERTEX * ends[1],
                                    part.vertices + VERTEX * part.apex[2 * e + which]};
    float *ramp = ramps + int64_t(count) * 4 * CORNER;
    if (write_ramp(clip_from_part, vertex, width_px / 2, height_px / 2, ramp_px, ramp)) ++count;
  }
  return count;
}
