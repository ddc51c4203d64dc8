#version 330 core
// All three panels in 8-bit codes; even beside the boxes.
#include "sample.glsl"
uniform isampler2D rear, centre, front;
uniform ivec2 rear_size, centre_size, front_size;
uniform ivec2 rear_origin, centre_origin, front_origin;
uniform bool grey;
layout(location = 0) out vec4 rear_codes;
layout(location = 1) out vec4 centre_codes;
layout(location = 2) out vec4 front_codes;

vec4 codes(isampler2D panel, ivec2 place, ivec2 size) {
    bool within = all(greaterThanEqual(place, ivec2(0))) && all(lessThan(place, size));
    ivec4 code = (within ? value(panel, place) + even + 8 : ivec4(even + 8)) >> 4;
    return vec4((grey ? vec3(code.r) : vec3(code.rgb)) / 255.0, 1.0);
}

void main() {
    ivec2 place = ivec2(gl_FragCoord.xy);
    rear_codes = codes(rear, place - rear_origin, rear_size);
    centre_codes = codes(centre, place - centre_origin, centre_size);
    front_codes = codes(front, place - front_origin, front_size);
}
