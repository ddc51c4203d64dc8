#version 330 core
// The centre panel that is best for the outer ones, from which joint steps begin.
#include "sample.glsl"
#include "wanted.glsl"
#include "slope.glsl"
uniform isampler2D rear, front;
uniform ivec2 rear_size, front_size;
uniform mat3 rear_from_left, rear_from_right, front_from_left, front_from_right;  // from the centre's pixels
out ivec4 panel;

void main() {
    ivec2 place = ivec2(gl_FragCoord.xy);
    ivec4 left_wanted = phases(wanted_left, place), right_wanted = phases(wanted_right, place);
    ivec4 left = left_wanted - 2 * even - crossed(rear, rear_size, rear_from_left, gl_FragCoord.xy);
    ivec4 right = right_wanted - 2 * even - crossed(rear, rear_size, rear_from_right, gl_FragCoord.xy);
    left -= crossed(front, front_size, front_from_left, gl_FragCoord.xy);
    right -= crossed(front, front_size, front_from_right, gl_FragCoord.xy);
    panel = rounded(weighed_best(left, right, slope(left_wanted), slope(right_wanted))) - even;
}
