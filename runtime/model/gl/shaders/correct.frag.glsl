#version 330 core
// One outer panel changed by what both eyes lack along the rays through each of its pixels.
uniform isampler2D left, right, panel;
uniform ivec2 size;         // of the centre panel's raster
uniform vec4 centre_from_left, centre_from_right;
uniform int eighths;
out ivec4 corrected;
#include "sample.glsl"
#include "shown.glsl"

void main() {
    vec2 by_left = gl_FragCoord.xy * centre_from_left.xy + centre_from_left.zw;
    vec2 by_right = gl_FragCoord.xy * centre_from_right.xy + centre_from_right.zw;
    ivec4 lacks = crossed(left, size, by_left, 0) + crossed(right, size, by_right, 0);
    corrected = kept(texelFetch(panel, ivec2(gl_FragCoord.xy), 0) + (lacks >> 3) * eighths);
}
