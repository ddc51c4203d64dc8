// Functions for positions in images. Positions are in pixels, with pixel centres at half-integers. An image occupies
// the first rows and columns of its texture. FULL and EDGE_CLAMP_PX are defined by programs.py, as in runtime/kernels.

vec2 place(mat3 homography) {
    vec3 at = homography * vec3(gl_FragCoord.xy - origin, 1.0);
    return at.z > 0.0 ? at.xy / at.z : vec2(-1e9);
}

bool inside(vec2 at, vec2 size, float near) {
    return all(greaterThanEqual(at, vec2(near - 1e-3))) && all(lessThanEqual(at, size - near + 1e-3));
}

// Sample an image bilinearly. Positions outside the image are clamped to its edges.
vec4 sampled(sampler2D image, vec2 at, vec2 size) {
    return texture(image, clamp(at, vec2(0.5), size - 0.5) / vec2(textureSize(image, 0)));
}

// Convert between numbers and the 16-bit values from 0 to 1 held in textures. Panel values are stored in a range from
// -1 to 2, because momentum may move them outside 0 to 1, and signed numbers in a range from -1 to 1.
vec4 panel(vec4 held) { return held * 3.0 - 1.0; }
vec4 held_panel(vec4 shown) { return (shown + 1.0) / 3.0; }
vec4 signed_number(vec4 held) { return held * 2.0 - 1.0; }
vec4 held_number(vec4 number) { return number * 0.5 + 0.5; }
