#version 330 core
// `blur` of two images of one size.
#include "sample.glsl"
#include "blur.glsl"
uniform isampler2D first, second;
layout(location = 0) out ivec4 first_mean;
layout(location = 1) out ivec4 second_mean;

void main() {
    first_mean = rounded(blurred(first));
    second_mean = rounded(blurred(second));
}
