#version 330 core
// What both eyes lack along the rays through each pixel of an outer panel, less what is left of the other panel in the
// mean over where the eyes may be, and joined by what moves of the panel itself: the next blur is of all of that.
#include "sample.glsl"
#include "blur.glsl"
#include "wanted.glsl"
#include "slope.glsl"
uniform isampler2D left, right;                              // what is lacked, and the other panel as it is seen
uniform isampler2D half_blurred_left, half_blurred_right;    // that panel alone, blurred across
uniform isampler2D mean, panel;
uniform mat3 centre_from_left, centre_from_right;
out ivec4 joined;

Weighed lacked(isampler2D image, isampler2D half_blurred, sampler2D wanted, mat3 centre_from_here) {
    vec2 place = moved(centre_from_here, gl_FragCoord.xy);
    if (beside(place, size) && !sheared(centre_from_here)) return BESIDE;
    vec2 low = floor(place - 0.5), weight = place - 0.5 - low;
    vec4 mean[4];
    blurred_down_around(half_blurred, ivec2(low), mean);
    Weighed sum = Weighed(vec4(0.0), vec4(0.0));
    for (int down = 0; down < 2; down++)
        for (int across = 0; across < 2; across++) {
            ivec2 corner = ivec2(across, down), pixel = clamp(ivec2(low) + corner, ivec2(0), size - 1);
            vec4 lacks = vec4(value(image, pixel)) - mean[2 * down + across];
            join(sum, corner, weight, lacks, slope(phases(wanted, pixel)));
        }
    return sum;
}

void main() {
    Weighed by_left = lacked(left, half_blurred_left, wanted_left, centre_from_left);
    vec4 lacks = answered(by_left, lacked(right, half_blurred_right, wanted_right, centre_from_right));
    ivec2 place = ivec2(gl_FragCoord.xy);
    joined = rounded(lacks + 2.0 * vec4(value(mean, place) - value(panel, place)));
}
