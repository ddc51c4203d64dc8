uniform float kernel[64];   // the middle and one side of a symmetric one
uniform int reach;
uniform ivec2 along;        // (1, 0) or (0, 1)
uniform ivec2 size;

vec4 blurred(isampler2D image) {
    ivec2 place = ivec2(gl_FragCoord.xy);
    vec4 sum = kernel[0] * vec4(value(image, place));
    for (int step = 1; step <= reach; step++)
        sum += kernel[step] * vec4(texel(image, place + step * along, size) + texel(image, place - step * along, size));
    return sum;
}

// Blurred down at the four pixels around a place, line by line; `at` is the first of them.
void blurred_down_around(isampler2D image, ivec2 at, out vec4 found[4]) {
    ivec2 first = clamp(at, ivec2(0), size - 1), next = clamp(at + 1, ivec2(0), size - 1);
    for (int corner = 0; corner < 4; corner++) found[corner] = vec4(0.0);
    for (int step = -reach; step <= reach + 1; step++) {
        int row = clamp(first.y + step, 0, size.y - 1);
        float above = step <= reach ? kernel[abs(step)] : 0.0, below = step > -reach ? kernel[abs(step - 1)] : 0.0;
        if (next.y == first.y) below = above;
        vec4 left = vec4(value(image, ivec2(first.x, row))), right = vec4(value(image, ivec2(next.x, row)));
        found[0] += above * left;
        found[1] += above * right;
        found[2] += below * left;
        found[3] += below * right;
    }
}
