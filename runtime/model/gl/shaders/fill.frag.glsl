#version 330 core
// Set each pixel of the middle panel to the mean residual of all the rays that pass through it, or to the rest value if
// there are none.
uniform vec2 origin;
#include "places.glsl"
#include "sets.glsl"
uniform float rest;
layout(location = 0) out vec4 now;

void main() {
    gather();
    vec4 weight = first_sum, residual = second_sum;
    vec4 mean = held_panel(clamp(2.0 * residual / max(weight, 1e-6), 0.0, 1.0));
    now = mix(held_panel(vec4(rest)), mean, vec4(greaterThan(weight, vec4(1e-5))));
}
