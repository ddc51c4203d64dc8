#version 330 core
// What a panel shows as cosine and sine of pi times it.
uniform vec2 origin;
#include "places.glsl"
uniform sampler2D ahead;
layout(location = 0) out vec4 cosine;
layout(location = 1) out vec4 sine;

void main() {
    vec4 angle = 3.14159265 * panel(texelFetch(ahead, ivec2(gl_FragCoord.xy), 0));
    cosine = held_number(cos(angle));
    sine = held_number(sin(angle));
}
