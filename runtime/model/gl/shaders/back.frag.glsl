#version 330 core
// What both eyes lack along the rays through each pixel of an outer panel, less what is left of the other panel in the
// mean over where the eyes may be, and joined by what moves of the panel itself: the next blur is of all of that.
#include "sample.glsl"
#include "blur.glsl"
uniform IMAGE left, right;                              // what is lacked, and the other panel as it is seen
uniform IMAGE half_blurred_left, half_blurred_right;    // that panel alone, blurred across
uniform IMAGE mean, panel;
uniform mat3 centre_from_left, centre_from_right;
out STORED joined;

vec4 lacked(IMAGE image, IMAGE half_blurred, mat3 centre_from_here) {
    vec2 place = moved(centre_from_here, gl_FragCoord.xy);
    if (beside(place, size) && !sheared(centre_from_here)) return vec4(0.0);
    return vec4(bilinear(image, size, place)) - blurred_down_at(half_blurred, place);
}

void main() {
    vec4 lacks = lacked(left, half_blurred_left, centre_from_left);
    lacks += lacked(right, half_blurred_right, centre_from_right);
    ivec2 place = ivec2(gl_FragCoord.xy);
    joined = stored(lacks + 2.0 * vec4(value(mean, place) - value(panel, place)));
}
