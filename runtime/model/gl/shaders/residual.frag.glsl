#version 330 core
// What each eye lacks at each pixel of the centre panel; where the eyes are unsure, also how they see one outer panel.
uniform bool of_front;      // which panel `seen` is of
layout(location = 0) out ivec4 left;
layout(location = 1) out ivec4 right;
layout(location = 2) out ivec4 seen_left;
layout(location = 3) out ivec4 seen_right;
#include "sample.glsl"
#include "lacks.glsl"

void main() {
    Look found = look(ivec2(gl_FragCoord.xy));
    left = found.left;
    right = found.right;
    seen_left = of_front ? found.front_left : found.rear_left;
    seen_right = of_front ? found.front_right : found.rear_right;
}
