uniform float kernel[64];   // the middle and one side of a symmetric one
uniform int reach;
uniform ivec2 along;        // (1, 0) or (0, 1)
uniform ivec2 size;

ivec4 blurred(isampler2D image) {
    ivec2 place = ivec2(gl_FragCoord.xy);
    vec4 sum = kernel[0] * vec4(texel(image, place, size));
    for (int step = 1; step <= reach; step++)
        sum += kernel[step] * vec4(texel(image, place + step * along, size) + texel(image, place - step * along, size));
    return rounded(sum);
}
