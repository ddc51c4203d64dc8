#version 330 core
// Set each pixel of the middle panel to the mean residual of all the rays that pass through it.
uniform vec2 origin;
#include "places.glsl"
uniform sampler2D last, weight0, residual0, weight1, residual1;
uniform mat3 rays_from0, rays_from1;
uniform vec2 rays;
layout(location = 0) out vec4 now;

vec4 weights = vec4(0.0), sums = vec4(0.0);

void gather(mat3 rays_from, sampler2D weight, sampler2D residual) {
    vec2 at = place(rays_from);
    if (!inside(at, rays, -EDGE_CLAMP_PX)) return;
    weights += sampled(weight, at, rays);
    sums += signed_number(sampled(residual, at, rays));
}

void main() {
    gather(rays_from0, weight0, residual0);
    gather(rays_from1, weight1, residual1);
    vec4 mean = held_panel(clamp(2.0 * sums / max(weights, 1e-6), 0.0, 1.0));
    now = mix(texelFetch(last, ivec2(gl_FragCoord.xy), 0), mean, vec4(greaterThan(weights, vec4(1e-4))));
}
