#version 330 core
// What each eye lacks at each pixel of the centre panel.
#include "sample.glsl"
#include "wanted.glsl"
#include "slope.glsl"
#include "lacks.glsl"
layout(location = 0) out STORED left;
layout(location = 1) out STORED right;

void main() {
    Look found = look(ivec2(gl_FragCoord.xy));
    left = stored(vec4(found.left));
    right = stored(vec4(found.right));
}
