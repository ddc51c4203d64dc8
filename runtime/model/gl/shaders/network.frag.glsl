#version 330 core
// What each eye lacks while the outer panels are even, half the difference of what both want, on the network's raster.
#include "sample.glsl"
#include "columns.glsl"
#include "wanted.glsl"
uniform ivec2 size;
uniform mat3 left_from_raster, right_from_raster;
layout(location = 0) out ivec4 lacks_left;
layout(location = 1) out ivec4 lacks_right;

vec4 half_difference(ivec2 place) {
    place = clamp(place, ivec2(0), size - 1);
    return vec4((phases(wanted_right, place) - phases(wanted_left, place)) >> 1);
}

ivec4 sampled(mat3 matrix, float sign) {
    vec2 place = moved(matrix, vec2(homography_from_column(gl_FragCoord.x), gl_FragCoord.y));
    if (beside(place, size) && !sheared(matrix)) return ivec4(0);
    vec2 low = floor(place - 0.5), weight = place - 0.5 - low;
    ivec2 at = ivec2(low);
    vec4 above = mix(half_difference(at), half_difference(at + ivec2(1, 0)), weight.x);
    vec4 below = mix(half_difference(at + ivec2(0, 1)), half_difference(at + ivec2(1, 1)), weight.x);
    return rounded(sign * mix(above, below, weight.y));
}

void main() {
    lacks_left = sampled(left_from_raster, -1.0);
    lacks_right = sampled(right_from_raster, 1.0);
}
