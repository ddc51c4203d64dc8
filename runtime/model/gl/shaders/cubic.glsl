vec4 cubic_weights(float t) {
    const float A = -0.75;  // as OpenCV's
    float s = 1.0 - t;
    vec4 w;
    w.x = ((A * (t + 1.0) - 5.0 * A) * (t + 1.0) + 8.0 * A) * (t + 1.0) - 4.0 * A;
    w.y = ((A + 2.0) * t - (A + 3.0)) * t * t + 1.0;
    w.z = ((A + 2.0) * s - (A + 3.0)) * s * s + 1.0;
    w.w = 1.0 - w.x - w.y - w.z;
    return w;
}

ivec4 cubic(isampler2D image, ivec2 size, vec2 place) {
    vec2 low = floor(place - 0.5), weight = place - 0.5 - low;
    ivec2 at = ivec2(low) - 1;
    vec4 across = cubic_weights(weight.x), down = cubic_weights(weight.y), sum = vec4(0.0);
    for (int row = 0; row < 4; row++) {
        vec4 line = vec4(0.0);
        for (int column = 0; column < 4; column++)
            line += across[column] * vec4(texel(image, at + ivec2(column, row), size));
        sum += down[row] * line;
    }
    return rounded(sum);
}
