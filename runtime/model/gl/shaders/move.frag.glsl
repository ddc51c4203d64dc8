#version 330 core
// Update one panel by a gradient step with momentum (docs/mathematics.md, L5).
uniform vec2 origin;
#include "places.glsl"
uniform sampler2D ahead, last, curvature0, gradient0, curvature1, gradient1;
uniform mat3 rays_from0, rays_from1;
#ifdef FOUR_SETS
uniform sampler2D curvature2, gradient2, curvature3, gradient3;
uniform mat3 rays_from2, rays_from3;
#endif
uniform vec2 rays;
uniform float size, momentum, least;
layout(location = 0) out vec4 moved;
layout(location = 1) out vec4 now;

vec4 curved = vec4(0.0), slope = vec4(0.0);

void gather(mat3 rays_from, sampler2D of_curvature, sampler2D of_gradient) {
    vec2 at = place(rays_from);
    if (!inside(at, rays, -EDGE_CLAMP_PX)) return;
    curved += sampled(of_curvature, at, rays);
    slope += signed_number(sampled(of_gradient, at, rays));
}

void main() {
    ivec2 here = ivec2(gl_FragCoord.xy);
    vec4 shown = panel(texelFetch(ahead, here, 0)), before = panel(texelFetch(last, here, 0));
    gather(rays_from0, curvature0, gradient0);
    gather(rays_from1, curvature1, gradient1);
#ifdef FOUR_SETS
    gather(rays_from2, curvature2, gradient2);
    gather(rays_from3, curvature3, gradient3);
#endif
    vec4 after = clamp(shown - size * slope / max(curved, least), 0.0, 1.0);
    now = held_panel(after);
    moved = held_panel(after + momentum * (after - before));
}
