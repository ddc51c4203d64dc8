#version 330 core
// `blur` of two images of one size.
#include "sample.glsl"
#include "blur.glsl"
uniform IMAGE first, second;
layout(location = 0) out STORED first_mean;
layout(location = 1) out STORED second_mean;

void main() {
    first_mean = stored(blurred(first));
    second_mean = stored(blurred(second));
}
