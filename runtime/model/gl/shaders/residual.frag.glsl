#version 330 core
// Compute the targets' weights for one eye's rays, and their products with the residuals that the middle panel must
// correct.
uniform vec2 origin;
#include "places.glsl"
uniform sampler2D targets, table;
#for PANELS
uniform sampler2D last@;
uniform mat3 from_rays@;
uniform vec2 size@;
#end
uniform int middle;
uniform ivec2 targets_origin;
uniform float rest, missing;
layout(location = 0) out vec4 weight;
layout(location = 1) out vec4 residual;

void main() {
    weight = vec4(0.0);
    residual = held_number(vec4(0.0));
    vec4 seen = vec4(0.0);
    float counts = 1.0;
#for PANELS
    vec2 at@ = place(from_rays@);
    bool crosses@ = inside(at@, size@, 0.0);
    if (middle == @ && !crosses@) return;
    if (middle != @) {
        seen += crosses@ ? panel(sampled(last@, at@, size@)) : vec4(rest);
        if (!crosses@) counts = missing;
    }
#end
    vec4 codes = texelFetch(targets, ivec2(gl_FragCoord.xy) + targets_origin, 0) * 255.0 + 0.5;
    for (int k = 0; k < 3; ++k) {
        vec2 entry = texelFetch(table, ivec2(int(codes[k]), 0), 0).rg;
        weight[k] = counts * entry.g;
        residual[k] = weight[k] * clamp(entry.r / FULL - seen[k], -1.0, 2.0) * 0.25 + 0.5;
    }
}
