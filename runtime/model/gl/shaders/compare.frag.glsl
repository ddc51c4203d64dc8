#version 330 core
// What both eyes see wrong along each ray, times the slope of the squared sine there, and that
// slope's square: `runtime.model.compiled.joint`, 1 to 3. Rays that leave a panel count for nothing.
#include "sample.glsl"
#include "rays.glsl"
uniform sampler2D target_left, target_right;  // 8-bit codes
uniform isampler2D rear, centre, front;
uniform ivec2 rear_size, centre_size, front_size;
uniform mat3 rear_from_left, centre_from_left, front_from_left;  // panels' pixels from the rays'
uniform mat3 rear_from_right, centre_from_right, front_from_right;
#include "ends.glsl"
layout(location = 0) out ivec4 push_left;
layout(location = 1) out ivec4 push_right;
layout(location = 2) out vec4 hold_left;
layout(location = 3) out vec4 hold_right;
const float HALF_TURN = 3.14159265358979;

bool crosses(vec2 place, ivec2 size) {
    return all(greaterThanEqual(place, vec2(0.5))) && all(lessThanEqual(place, vec2(size) - 0.5));
}

void compare(sampler2D target, mat3 to_rear, mat3 to_centre, mat3 to_front, out ivec4 push, out vec4 hold) {
    ivec2 at = ivec2(gl_FragCoord.xy);
    vec2 behind = moved(to_rear, gl_FragCoord.xy), between_them = moved(to_centre, gl_FragCoord.xy);
    vec2 before = moved(to_front, gl_FragCoord.xy);
    push = ivec4(0);
    hold = vec4(0.0);
    if (!crosses(behind, rear_size) || !crosses(before, front_size)) return;
    if (!crosses(between_them, centre_size)) return;
    vec4 sum = between(rear, rear_size, behind) + between(front, front_size, before);
    sum += between(centre, centre_size, between_them);
    vec4 turn = (sum + 3.0 * even) / (2.0 * even) * HALF_TURN;
    vec4 slope = sin(turn), seen = 0.5 - 0.5 * cos(turn);
    push = rounded(slope * (seen - texelFetch(target, at, 0)) * share(at) * PUSH);
    hold = slope * slope;
}

void main() {
    compare(target_left, rear_from_left, centre_from_left, front_from_left, push_left, hold_left);
    compare(target_right, rear_from_right, centre_from_right, front_from_right, push_right, hold_right);
}
