#version 330 core
// A window's layers among the rest, where the outer panels are even and the centre panel carries what both eyes see.
uniform sampler2D rear, centre, front;  // the window's
uniform ivec4 window, kept;             // left, top, right, bottom: of every panel, of the centre one; empty: none
uniform bool pictured;                  // whether the rest is a picture; else one colour
uniform sampler2D picture, codes;       // what both eyes see; the centre panel's code for each of the picture's
uniform vec3 colour;                    // the centre panel's codes
uniform float even;
layout(location = 0) out vec4 rear_shown;
layout(location = 1) out vec4 centre_shown;
layout(location = 2) out vec4 front_shown;
#include "picture.glsl"

bool within(ivec2 place, ivec4 area) {
    return all(greaterThanEqual(place, area.xy)) && all(lessThan(place, area.zw));
}

float centre_code(float seen) {
    return texelFetch(codes, ivec2(int(roundEven(seen)), 0), 0).r;
}

vec4 rest(ivec2 place) {
    if (!pictured) return vec4(colour / 255.0, 1.0);
    vec3 seen = sharp(picture, place);
    return vec4(centre_code(seen.r), centre_code(seen.g), centre_code(seen.b), 1.0);
}

vec4 solved(sampler2D layer, ivec2 place) {
    return vec4(texelFetch(layer, place - window.xy, 0).rgb, 1.0);
}

void main() {
    ivec2 place = ivec2(gl_FragCoord.xy);
    vec4 beside = vec4(vec3(even / 255.0), 1.0);
    bool inside = within(place, window);
    rear_shown = inside ? solved(rear, place) : beside;
    front_shown = inside ? solved(front, place) : beside;
    centre_shown = within(place, kept) ? solved(centre, place) : rest(place);
}
