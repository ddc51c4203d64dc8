#version 330 core
// The centre panel that is best for the outer ones, from which joint steps begin.
#include "sample.glsl"
#include "wanted.glsl"
uniform isampler2D rear, front;
uniform ivec2 rear_size, front_size;
uniform mat3 rear_from_left, rear_from_right, front_from_left, front_from_right;  // from the centre's pixels
out ivec4 panel;

void main() {
    ivec4 best = phases(wanted_left, ivec2(gl_FragCoord.xy)) + phases(wanted_right, ivec2(gl_FragCoord.xy)) - 6 * even;
    best -= crossed(rear, rear_size, rear_from_left, gl_FragCoord.xy);
    best -= crossed(rear, rear_size, rear_from_right, gl_FragCoord.xy);
    best -= crossed(front, front_size, front_from_left, gl_FragCoord.xy);
    best -= crossed(front, front_size, front_from_right, gl_FragCoord.xy);
    panel = clamp(best >> 1, ivec4(-even), ivec4(even));
}
