#version 330 core
// A panel, moved by what both eyes see wrong along the rays through each of its pixels: `runtime.model.compiled.joint`,
// 4 and 5. UNSURE: eyes at two places, instead of one.
#include "sample.glsl"
#include "rays.glsl"
uniform isampler2D ahead, last;  // the panel with momentum, which was seen, and without
uniform ivec2 size;              // of the rays' raster
uniform isampler2D push_left, push_right;
uniform sampler2D hold_left, hold_right;
uniform mat3 rays_from_left, rays_from_right;  // from this panel's pixels
#ifdef UNSURE
uniform isampler2D push_left_2, push_right_2;
uniform sampler2D hold_left_2, hold_right_2;
uniform mat3 rays_from_left_2, rays_from_right_2;
#endif
uniform float step_size, momentum, least_hold;
layout(location = 0) out ivec4 ahead_moved;
layout(location = 1) out ivec4 last_moved;
const float QUARTER_TURN = 1.5707963267948966;

void bring_back(isampler2D push, sampler2D hold, mat3 matrix, inout vec4 pushes, inout vec4 holds) {
    vec2 place = moved(matrix, gl_FragCoord.xy);
    if (any(lessThan(place, vec2(0.0))) || any(greaterThan(place, vec2(size)))) return;
    pushes += between(push, size, place) / PUSH;
    holds += between(hold, size, place);
}

void main() {
    vec4 pushes = vec4(0.0), holds = vec4(0.0);
    bring_back(push_left, hold_left, rays_from_left, pushes, holds);
    bring_back(push_right, hold_right, rays_from_right, pushes, holds);
#ifdef UNSURE
    bring_back(push_left_2, hold_left_2, rays_from_left_2, pushes, holds);
    bring_back(push_right_2, hold_right_2, rays_from_right_2, pushes, holds);
#endif
    ivec2 at = ivec2(gl_FragCoord.xy);
    vec4 change = step_size * 2.0 * even / (3.0 * QUARTER_TURN) * pushes / max(holds, least_hold);
    vec4 now = clamp(vec4(value(ahead, at)) - change, -float(even), float(even));
    last_moved = ivec4(floor(now + 0.5));
    ahead_moved = ivec4(floor(now + momentum * (now - vec4(value(last, at))) + 0.5));
}
