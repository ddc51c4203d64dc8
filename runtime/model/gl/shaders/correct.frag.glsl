#version 330 core
// One outer panel changed by what both eyes lack along the rays through each of its pixels.
uniform isampler2D left, right, panel;
uniform ivec2 size;         // of the centre panel's raster
uniform mat3 centre_from_left, centre_from_right;
uniform int eighths;
out ivec4 corrected;
#include "sample.glsl"
#include "shown.glsl"

void main() {
    vec2 at = gl_FragCoord.xy;
    ivec4 lacks = crossed(left, size, centre_from_left, at, 0) + crossed(right, size, centre_from_right, at, 0);
    corrected = kept(texelFetch(panel, ivec2(gl_FragCoord.xy), 0) + (lacks >> 3) * eighths);
}
