#version 330 core
// Update one panel by a gradient step with momentum (docs/mathematics.md, L5).
uniform vec2 origin;
#include "places.glsl"
#include "sets.glsl"
uniform sampler2D ahead, last;
uniform float size, momentum, least;
layout(location = 0) out vec4 moved;
layout(location = 1) out vec4 now;

void main() {
    ivec2 here = ivec2(gl_FragCoord.xy);
    vec4 shown = panel(texelFetch(ahead, here, 0)), before = panel(texelFetch(last, here, 0));
    gather();
    vec4 curvature = first_sum, gradient = second_sum;
    vec4 after = clamp(shown - size * gradient / max(curvature, least), 0.0, 1.0);
    now = held_panel(after);
    moved = held_panel(after + momentum * (after - before));
}
