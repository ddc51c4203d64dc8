#version 330 core
// What each eye lacks at each pixel of the centre panel. Where the eyes are unsure, how they see the panel that is not
// corrected joins it, and is answered too: what is left of that in the mean is taken off later (`noise`).
uniform bool unsure;
uniform bool of_front;      // which panel `seen` is of
layout(location = 0) out ivec4 left;
layout(location = 1) out ivec4 right;
layout(location = 2) out ivec4 seen_left;
layout(location = 3) out ivec4 seen_right;
#include "sample.glsl"
#include "lacks.glsl"

void main() {
    Look found = look(ivec2(gl_FragCoord.xy));
    seen_left = of_front ? found.front_left : found.rear_left;
    seen_right = of_front ? found.front_right : found.rear_right;
    left = unsure ? found.left + seen_left : found.left;
    right = unsure ? found.right + seen_right : found.right;
}
