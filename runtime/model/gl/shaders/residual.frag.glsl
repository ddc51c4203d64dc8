#version 330 core
// What each eye lacks at each pixel of the centre panel.
#include "sample.glsl"
#include "wanted.glsl"
#include "slope.glsl"
#include "lacks.glsl"
layout(location = 0) out ivec4 left;
layout(location = 1) out ivec4 right;

void main() {
    Look found = look(ivec2(gl_FragCoord.xy));
    left = found.left;
    right = found.right;
}
