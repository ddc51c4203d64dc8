#version 330 core
// All three panels in 8-bit codes: the centre one the best for the outer ones, per pixel; even beside the boxes.
#include "sample.glsl"
#include "wanted.glsl"
#include "slope.glsl"
uniform isampler2D rear, front;                           // as they are
uniform isampler2D rear_mean, front_mean;                 // as eyes that are unsure see them
uniform ivec2 rear_size, front_size, centre_size;
uniform ivec2 rear_origin, front_origin, centre_origin;
uniform mat3 rear_from_left, rear_from_right, front_from_left, front_from_right;
uniform int neutral;
layout(location = 0) out vec4 rear_codes;
layout(location = 1) out vec4 centre_codes;
layout(location = 2) out vec4 front_codes;

bool within(ivec2 place, ivec2 size) {
    return all(greaterThanEqual(place, ivec2(0))) && all(lessThan(place, size));
}

vec4 coloured(ivec4 codes) {
    return vec4((grey ? vec3(codes.r) : vec3(codes.rgb)) / 255.0, 1.0);
}

vec4 outer(isampler2D image, ivec2 place, ivec2 size) {
    if (!within(place, size)) return coloured(ivec4(neutral));
    return coloured(rounded(vec4(value(image, place) + even) / 16.0));
}

vec4 centre(ivec2 place) {
    if (!within(place, centre_size)) return coloured(ivec4(neutral));
    vec2 at = vec2(place) + 0.5;
    ivec4 left_wanted = phases(wanted_left, place), right_wanted = phases(wanted_right, place);
    ivec4 left = left_wanted - 2 * even - crossed(rear_mean, rear_size, rear_from_left, at);
    ivec4 right = right_wanted - 2 * even - crossed(rear_mean, rear_size, rear_from_right, at);
    left -= crossed(front_mean, front_size, front_from_left, at);
    right -= crossed(front_mean, front_size, front_from_right, at);
    vec4 mean = weighed_best(left, right, slope(left_wanted), slope(right_wanted));
    return coloured(ivec4(floor(mean / 16.0 + 0.5)));
}

void main() {
    ivec2 place = ivec2(gl_FragCoord.xy);
    rear_codes = outer(rear, place - rear_origin, rear_size);
    centre_codes = centre(place - centre_origin);
    front_codes = outer(front, place - front_origin, front_size);
}
