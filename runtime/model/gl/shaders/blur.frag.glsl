#version 330 core
// The mean over where the eyes may be, along one direction.
#include "sample.glsl"
#include "blur.glsl"
uniform IMAGE image;
out STORED mean;

void main() {
    mean = stored(blurred(image));
}
