// Images hold signed sixteenths of an 8-bit code; row 0 is the top. Places are pixels with centres at half-integers.
// Weights have full precision, which hardware's filters (1/256) have not.
const float EDGE = 1e-3;  // pixels: a place on an image's very edge is within, however it was rounded

ivec4 texel(isampler2D image, ivec2 place, ivec2 size) {
    return texelFetch(image, clamp(place, ivec2(0), size - 1), 0);
}

bool beside(vec2 place, ivec2 size) {
    return any(lessThan(place, vec2(-EDGE))) || any(greaterThan(place, vec2(size) + EDGE));
}

ivec4 rounded(vec4 value) {
    return ivec4(roundEven(value));
}

ivec4 bilinear(isampler2D image, ivec2 size, vec2 place) {
    vec2 low = floor(place - 0.5), weight = place - 0.5 - low;
    ivec2 at = ivec2(low);
    vec4 above = mix(vec4(texel(image, at, size)), vec4(texel(image, at + ivec2(1, 0), size)), weight.x);
    vec4 below = mix(vec4(texel(image, at + ivec2(0, 1), size)), vec4(texel(image, at + ivec2(1, 1), size)), weight.x);
    return rounded(mix(above, below, weight.y));
}

// What a ray meets that leaves an image is `outside`: nobody sees it, for it does not cross every panel.
ivec4 crossed(isampler2D image, ivec2 size, vec2 place, int outside) {
    return beside(place, size) ? ivec4(outside) : bilinear(image, size, place);
}
