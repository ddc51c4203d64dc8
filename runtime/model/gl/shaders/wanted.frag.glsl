#version 330 core
// The phase sums that two pictures ask for: sharpened, averaged to a coarser raster, looked up.
uniform sampler2D left, right;
uniform isampler2D table;   // 256 phases
uniform vec2 reduction;     // pixels of the box to one of the result
uniform bool grey;
layout(location = 0) out ivec4 wanted_left;
layout(location = 1) out ivec4 wanted_right;
#include "picture.glsl"

vec3 averaged(sampler2D picture) {
    vec2 low = floor(gl_FragCoord.xy) * reduction, high = min(low + reduction, vec2(box));
    ivec2 first = ivec2(floor(low + 1e-4)), last = ivec2(ceil(high - 1e-4)) - 1;
    vec3 sum = vec3(0.0);
    float total = 0.0;
    for (int v = first.y; v <= last.y; v++)
        for (int u = first.x; u <= last.x; u++) {
            vec2 at = vec2(u, v), share = min(at + 1.0, high) - max(at, low);
            float weight = share.x * share.y;
            sum += weight * sharp(picture, ivec2(u, v));
            total += weight;
        }
    vec3 mean = sum / total;
    return reduction == floor(reduction) ? floor(mean + 0.5) : roundEven(mean);  // as OpenCV rounds
}

ivec4 phases(sampler2D picture) {
    bool same = reduction == vec2(1.0);
    ivec3 codes = ivec3(same ? sharp(picture, ivec2(gl_FragCoord.xy)) : averaged(picture));
    int red = texelFetch(table, ivec2(codes.r, 0), 0).r;
    if (grey) return ivec4(red);
    return ivec4(red, texelFetch(table, ivec2(codes.g, 0), 0).r, texelFetch(table, ivec2(codes.b, 0), 0).r, 0);
}

void main() {
    wanted_left = phases(left);
    wanted_right = phases(right);
}
