#version 330 core
// What each eye lacks at each pixel of the centre panel when that panel is the best one for the outer ones; where the
// eyes are unsure, also how they see one outer panel.
uniform isampler2D wanted_left, wanted_right, rear, front;
uniform ivec2 rear_size, front_size;
uniform vec4 rear_from_left, rear_from_right, front_from_left, front_from_right;  // of the centre's pixels: scale, shift
uniform int even;
uniform bool of_front;      // which panel `seen` is of
// How a part of larger panels ends: nothing beyond `kept` (left, top, right, bottom) drives the panels.
uniform vec4 kept;
uniform vec4 over;          // pixels over which each side fades; 0: it does not
uniform vec4 centre_from_here;  // the whole centre panel's pixels: scale, shift
layout(location = 0) out ivec4 left;
layout(location = 1) out ivec4 right;
layout(location = 2) out ivec4 seen_left;
layout(location = 3) out ivec4 seen_right;
#include "sample.glsl"

ivec4 faded(ivec4 value) {
    if (over == vec4(0.0)) return value;
    vec2 at = gl_FragCoord.xy * centre_from_here.xy + centre_from_here.zw;
    float inside[4] = float[4](at.x - kept.x, kept.z - at.x, at.y - kept.y, kept.w - at.y);
    float reach[4] = float[4](over.x, over.z, over.y, over.w);
    for (int side = 0; side < 4; side++)
        if (reach[side] > 0.0) value = (value * int(clamp(roundEven(inside[side] / reach[side] * 4.0), 0.0, 4.0))) >> 2;
    return value;
}

void main() {
    ivec2 place = ivec2(gl_FragCoord.xy);
    ivec4 rear_left = crossed(rear, rear_size, rear_from_left, even);
    ivec4 rear_right = crossed(rear, rear_size, rear_from_right, even);
    ivec4 front_left = crossed(front, front_size, front_from_left, even);
    ivec4 front_right = crossed(front, front_size, front_from_right, even);
    ivec4 needs_left = texelFetch(wanted_left, place, 0) - rear_left - front_left;
    ivec4 needs_right = texelFetch(wanted_right, place, 0) - rear_right - front_right;
    ivec4 best = clamp((needs_left + needs_right) >> 1, 0, 4080);
    left = faded(needs_left - best);
    right = faded(needs_right - best);
    seen_left = of_front ? front_left : rear_left;
    seen_right = of_front ? front_right : rear_right;
}
