#version 330 core
// What both eyes lack along the rays through each pixel of an outer panel.
uniform isampler2D left, right;
uniform ivec2 size;
uniform vec4 centre_from_left, centre_from_right;
out ivec4 lacks;
#include "sample.glsl"

void main() {
    vec2 by_left = gl_FragCoord.xy * centre_from_left.xy + centre_from_left.zw;
    vec2 by_right = gl_FragCoord.xy * centre_from_right.xy + centre_from_right.zw;
    lacks = crossed(left, size, by_left, 0) + crossed(right, size, by_right, 0);
}
