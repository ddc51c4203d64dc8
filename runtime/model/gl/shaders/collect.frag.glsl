#version 330 core
// Collect the sums over some ray sets, divided by the number of all sets, because a shader can only read a few images.
uniform vec2 origin;
#include "places.glsl"
#include "sets.glsl"
uniform float total;
layout(location = 0) out vec4 first_mean;
layout(location = 1) out vec4 second_mean;

void main() {
    gather();
    first_mean = first_sum / total;
    second_mean = held_number(second_sum / total);
}
