#version 330 core
// What both eyes lack along the rays through each pixel of an outer panel.
uniform isampler2D left, right;
uniform ivec2 size;
uniform mat3 centre_from_left, centre_from_right;
out ivec4 lacks;
#include "sample.glsl"

void main() {
    vec2 at = gl_FragCoord.xy;
    lacks = crossed(left, size, centre_from_left, at, 0) + crossed(right, size, centre_from_right, at, 0);
}
