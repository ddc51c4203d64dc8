// Images hold signed sixteenths of an 8-bit code; outer panels' from the middle of their range, so that 0 is even.
// Row 0 is the top, and places are pixels with centres at half-integers.
// Weights have full precision, which hardware's filters (1/256) have not.
uniform int even;  // of an outer panel
const float EDGE = 1e-3;  // pixels: a place on an image's very edge is within, however it was rounded

ivec4 value(isampler2D image, ivec2 place) {
    return texelFetch(image, place, 0);
}

ivec4 texel(isampler2D image, ivec2 place, ivec2 size) {
    return value(image, clamp(place, ivec2(0), size - 1));
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

// Images are mapped by 3x3 matrices: a scale and a shift, or more where heads or panels are tilted.
vec2 moved(mat3 matrix, vec2 at) {
    vec3 place = matrix * vec3(at, 1.0);
    return place.xy / place.z;
}

bool sheared(mat3 matrix) {
    return matrix[1].x != 0.0 || matrix[0].y != 0.0 || matrix[0].z != 0.0 || matrix[1].z != 0.0;
}

// What a ray meets that leaves an image is even, or where that is sheared its repeated edge: nobody sees it, for it
// does not cross every panel.
ivec4 crossed(isampler2D image, ivec2 size, mat3 image_from_here, vec2 at) {
    vec2 place = moved(image_from_here, at);
    return beside(place, size) && !sheared(image_from_here) ? ivec4(0) : bilinear(image, size, place);
}
