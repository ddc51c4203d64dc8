#version 330 core
// Convert a panel's values from sixteenths of a code.
uniform vec2 origin;
#include "places.glsl"
uniform isampler2D codes;
uniform bool grey;  // the panel has one value for all channels
layout(location = 0) out vec4 now;

void main() {
    vec4 shown = vec4(texelFetch(codes, ivec2(gl_FragCoord.xy), 0)) / FULL;
    now = held_panel(grey ? vec4(dot(shown.rgb, vec3(1.0 / 3.0))) : shown);
}
