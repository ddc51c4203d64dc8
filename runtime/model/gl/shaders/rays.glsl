// Bilinear samples as they are: along rays, nothing is rounded. A place is within the image.
const float PUSH = 16384.0;  // of a product of slope and error, in 16 bits

vec4 texel_of(isampler2D image, ivec2 place, ivec2 size) {
    return vec4(texelFetch(image, clamp(place, ivec2(0), size - 1), 0));
}

vec4 texel_of(sampler2D image, ivec2 place, ivec2 size) {
    return texelFetch(image, clamp(place, ivec2(0), size - 1), 0);
}

#define BETWEEN(KIND) \
vec4 between(KIND image, ivec2 size, vec2 place) { \
    vec2 low = floor(place - 0.5), weight = place - 0.5 - low; \
    ivec2 at = ivec2(low); \
    vec4 above = mix(texel_of(image, at, size), texel_of(image, at + ivec2(1, 0), size), weight.x); \
    vec4 below = mix(texel_of(image, at + ivec2(0, 1), size), texel_of(image, at + ivec2(1, 1), size), weight.x); \
    return mix(above, below, weight.y); \
}
BETWEEN(isampler2D)
BETWEEN(sampler2D)
