#version 330 core
// `residual` for eyes that are unsure: how they see the panel that is not corrected joins what they lack, and is
// answered too: what is left of that in the mean over where they may be is taken off later (`back`).
#include "sample.glsl"
#include "wanted.glsl"
#include "slope.glsl"
#include "lacks.glsl"
uniform bool of_front;      // which panel moves
layout(location = 0) out ivec4 left;
layout(location = 1) out ivec4 right;
layout(location = 2) out ivec4 moving_left;
layout(location = 3) out ivec4 moving_right;

void main() {
    Look found = look(ivec2(gl_FragCoord.xy));
    ivec4 by_left = of_front ? found.front_left : found.rear_left;
    ivec4 by_right = of_front ? found.front_right : found.rear_right;
    left = found.left + by_left;
    right = found.right + by_right;
    moving_left = by_left;
    moving_right = by_right;
}
