#version 330 core
// Convert a panel's box to 8-bit codes, drawn at its position within the whole panel.
uniform vec2 origin;
#include "places.glsl"
uniform sampler2D last;
uniform ivec2 first;
uniform bool grey;
layout(location = 0) out vec4 codes;

void main() {
    vec4 shown = panel(texelFetch(last, ivec2(gl_FragCoord.xy - origin) + first, 0));
    codes = vec4(floor((grey ? shown.rrr : shown.rgb) * 255.0 + 0.5) / 255.0, 1.0);
}
