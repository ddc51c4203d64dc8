#version 330 core
// The mean over where the eyes may be, along one direction.
#include "sample.glsl"
#include "blur.glsl"
uniform isampler2D image;
out ivec4 mean;

void main() {
    mean = rounded(blurred(image));
}
