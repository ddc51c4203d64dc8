#version 330 core
// What both eyes lack along the rays through each pixel of an outer panel.
uniform isampler2D left, right;
uniform ivec2 size;
uniform vec4 centre_from_left, centre_from_right;
out ivec4 lacks;
#include "sample.glsl"

void main() {
    lacks = crossed(left, size, centre_from_left, 0) + crossed(right, size, centre_from_right, 0);
}
