#version 330 core
// What both eyes lack, joined by what moves of the other panel where the eyes are unsure.
uniform isampler2D left, right;                      // what is lacked
uniform isampler2D seen_left, seen_right;            // the other panel
uniform isampler2D half_blurred_left, half_blurred_right;  // the same, blurred across
layout(location = 0) out ivec4 joined_left;
layout(location = 1) out ivec4 joined_right;
#include "sample.glsl"
#include "blur.glsl"

void main() {
    ivec2 place = ivec2(gl_FragCoord.xy);
    joined_left = texelFetch(left, place, 0) + texelFetch(seen_left, place, 0) - blurred(half_blurred_left);
    joined_right = texelFetch(right, place, 0) + texelFetch(seen_right, place, 0) - blurred(half_blurred_right);
}
