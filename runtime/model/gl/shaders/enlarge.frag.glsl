#version 330 core
// Layers of fewer pixels on the whole panels: bilinear, with their outermost pixels repeated.
uniform sampler2D rear, centre, front;
uniform ivec2 size;
uniform vec2 layer_from_panel;  // scale
layout(location = 0) out vec4 rear_shown;
layout(location = 1) out vec4 centre_shown;
layout(location = 2) out vec4 front_shown;

vec3 texel(sampler2D layer, ivec2 place) {
    return texelFetch(layer, clamp(place, ivec2(0), size - 1), 0).rgb;
}

// Weights have full precision, which hardware's filters (1/256) have not.
vec4 enlarged(sampler2D layer, ivec2 at, vec2 weight) {
    vec3 above = mix(texel(layer, at), texel(layer, at + ivec2(1, 0)), weight.x);
    vec3 below = mix(texel(layer, at + ivec2(0, 1)), texel(layer, at + ivec2(1, 1)), weight.x);
    return vec4(mix(above, below, weight.y), 1.0);
}

void main() {
    vec2 place = gl_FragCoord.xy * layer_from_panel - 0.5, low = floor(place), weight = place - low;
    ivec2 at = ivec2(low);
    rear_shown = enlarged(rear, at, weight);
    centre_shown = enlarged(centre, at, weight);
    front_shown = enlarged(front, at, weight);
}
