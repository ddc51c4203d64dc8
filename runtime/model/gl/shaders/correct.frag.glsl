#version 330 core
// One outer panel changed by what both eyes lack along the rays through each of its pixels.
#include "sample.glsl"
#include "shown.glsl"
uniform IMAGE left, right, panel;
uniform ivec2 size;         // of the centre panel's raster
uniform mat3 centre_from_left, centre_from_right;
uniform int eighths;
out STORED corrected;

void main() {
    vec2 at = gl_FragCoord.xy;
    ivec4 lacks = crossed(left, size, centre_from_left, at) + crossed(right, size, centre_from_right, at);
    corrected = kept(value(panel, ivec2(at)) + (lacks >> 3) * eighths);
}
