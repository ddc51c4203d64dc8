// Places in images: pixels, centres at halves. An image is the first pixels of a texture.
const float FULL = 4080.0;  // of a panel that shows 1, sixteenths of a code
const float EDGE_CLAMP_PX = 2.0;  // border ray bundles are extended this many pixels beyond the picture (clamp to edge)

vec2 place(mat3 homography) {
    vec3 at = homography * vec3(gl_FragCoord.xy - origin, 1.0);
    return at.z > 0.0 ? at.xy / at.z : vec2(-1e9);
}

bool inside(vec2 at, vec2 size, float near) {
    return all(greaterThanEqual(at, vec2(near - 1e-3))) && all(lessThanEqual(at, size - near + 1e-3));
}

// Bilinear; an image's edges go on.
vec4 sampled(sampler2D image, vec2 at, vec2 size) {
    return texture(image, clamp(at, vec2(0.5), size - 0.5) / vec2(textureSize(image, 0)));
}

// What 16 bits from 0 to 1 hold: panels as far as momentum takes them, and numbers of either sign.
vec4 panel(vec4 held) { return held * 3.0 - 1.0; }
vec4 held_panel(vec4 shown) { return (shown + 1.0) / 3.0; }
vec4 signed_number(vec4 held) { return held * 2.0 - 1.0; }
vec4 held_number(vec4 number) { return number * 0.5 + 0.5; }
