#version 330 core
// The mean over where the eyes may be, along one direction, of two images of one size (or of one, twice).
uniform isampler2D first, second;
layout(location = 0) out ivec4 first_blurred;
layout(location = 1) out ivec4 second_blurred;
#include "sample.glsl"
#include "blur.glsl"

void main() {
    first_blurred = blurred(first);
    second_blurred = blurred(second);
}
