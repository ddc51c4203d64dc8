#version 330 core
// What the eyes want, in 8-bit codes: two pictures sharpened, and averaged to a coarser raster.
uniform sampler2D left, right;
uniform vec2 reduction;     // pixels of the box to one of the result
layout(location = 0) out vec4 wanted_left;
layout(location = 1) out vec4 wanted_right;
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

vec4 codes(sampler2D picture) {
    vec3 found = reduction == vec2(1.0) ? sharp(picture, ivec2(gl_FragCoord.xy)) : averaged(picture);
    return vec4(found / 255.0, 1.0);
}

void main() {
    wanted_left = codes(left);
    wanted_right = codes(right);
}
