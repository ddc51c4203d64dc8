#version 330 core
// One outer panel changed by what both eyes lack along the rays through each of its pixels.
#include "sample.glsl"
#include "wanted.glsl"
#include "slope.glsl"
#include "shown.glsl"
uniform isampler2D left, right, panel;
uniform ivec2 size;         // of the centre panel's raster
uniform mat3 centre_from_left, centre_from_right;
uniform float share;        // of what is lacked
out ivec4 corrected;

Weighed lacked(isampler2D image, sampler2D wanted, mat3 centre_from_here) {
    vec2 place = moved(centre_from_here, gl_FragCoord.xy);
    if (beside(place, size) && !sheared(centre_from_here)) return BESIDE;
    vec2 low = floor(place - 0.5), weight = place - 0.5 - low;
    Weighed sum = Weighed(vec4(0.0), vec4(0.0));
    for (int down = 0; down < 2; down++)
        for (int across = 0; across < 2; across++) {
            ivec2 corner = ivec2(across, down), pixel = clamp(ivec2(low) + corner, ivec2(0), size - 1);
            join(sum, corner, weight, vec4(value(image, pixel)), slope(phases(wanted, pixel)));
        }
    return sum;
}

void main() {
    vec2 at = gl_FragCoord.xy;
    Weighed by_left = lacked(left, wanted_left, centre_from_left);
    ivec4 lacks = rounded(answered(by_left, lacked(right, wanted_right, centre_from_right)));
    corrected = kept(value(panel, ivec2(at)) + times(lacks, share));
}
