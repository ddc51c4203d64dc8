#version 330 core
// `residual` and `correct` in one: no image in between, but four looks an eye for each pixel of the panel.
#include "sample.glsl"
#include "wanted.glsl"
#include "slope.glsl"
#include "lacks.glsl"
#include "shown.glsl"
uniform IMAGE panel;
uniform ivec2 size;         // of the centre panel's raster
uniform mat3 centre_from_left, centre_from_right;
uniform int eighths;
out STORED corrected;

#ifdef SLOPED
Weighed lacked(mat3 centre_from_here, bool by_left) {
    vec2 place = moved(centre_from_here, gl_FragCoord.xy);
    if (beside(place, size) && !sheared(centre_from_here)) return BESIDE;
    vec2 low = floor(place - 0.5), weight = place - 0.5 - low;
    Weighed sum = Weighed(vec4(0.0), vec4(0.0));
    for (int down = 0; down < 2; down++)
        for (int across = 0; across < 2; across++) {
            ivec2 corner = ivec2(across, down);
            Look found = look(clamp(ivec2(low) + corner, ivec2(0), size - 1));
            vec4 slope = by_left ? found.left_slope : found.right_slope;
            join(sum, corner, weight, vec4(by_left ? found.left : found.right), slope);
        }
    return sum;
}
#else
ivec4 lacked(mat3 centre_from_here, bool by_left) {
    vec2 place = moved(centre_from_here, gl_FragCoord.xy);
    if (beside(place, size) && !sheared(centre_from_here)) return ivec4(0);
    vec2 low = floor(place - 0.5), weight = place - 0.5 - low;
    vec4 lines[2];
    for (int down = 0; down < 2; down++) {
        vec4 values[2];
        for (int across = 0; across < 2; across++) {
            Look found = look(clamp(ivec2(low) + ivec2(across, down), ivec2(0), size - 1));
            values[across] = vec4(by_left ? found.left : found.right);
        }
        lines[down] = mix(values[0], values[1], weight.x);
    }
    return rounded(mix(lines[0], lines[1], weight.y));
}
#endif

void main() {
#ifdef SLOPED
    ivec4 lacks = rounded(answered(lacked(centre_from_left, true), lacked(centre_from_right, false)));
#else
    ivec4 lacks = lacked(centre_from_left, true) + lacked(centre_from_right, false);
#endif
    corrected = kept(value(panel, ivec2(gl_FragCoord.xy)) + times(lacks, eighths));
}
