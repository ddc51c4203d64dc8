#version 330 core
// Compute the targets' weights for one eye's rays, and their products with the residuals that the middle panel must
// correct.
uniform vec2 origin;
#include "places.glsl"
uniform sampler2D last0, last2, targets, table;
uniform mat3 from_rays0, from_rays1, from_rays2;
uniform vec2 size0, size1, size2;
uniform ivec2 targets_origin;
uniform float rest, missing;
layout(location = 0) out vec4 weight;
layout(location = 1) out vec4 residual;

vec4 outer(sampler2D last, vec2 at, vec2 size) {
    return inside(at, size, 0.0) ? panel(sampled(last, at, size)) : vec4(rest);
}

void main() {
    weight = vec4(0.0);
    residual = held_number(vec4(0.0));
    if (!inside(place(from_rays1), size1, 0.0)) return;
    vec2 at0 = place(from_rays0), at2 = place(from_rays2);
    vec4 seen = outer(last0, at0, size0) + outer(last2, at2, size2);
    float counts = inside(at0, size0, 0.0) && inside(at2, size2, 0.0) ? 1.0 : missing;
    vec4 codes = texelFetch(targets, ivec2(gl_FragCoord.xy) + targets_origin, 0) * 255.0 + 0.5;
    for (int k = 0; k < 3; ++k) {
        vec2 entry = texelFetch(table, ivec2(int(codes[k]), 0), 0).rg;
        weight[k] = counts * entry.g;
        residual[k] = weight[k] * clamp(entry.r / FULL - seen[k], -1.0, 2.0) * 0.25 + 0.5;
    }
}
