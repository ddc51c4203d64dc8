// A picture of 8-bit codes, sharpened as `targets.pre_emphasised` does it.
uniform ivec2 origin;       // of the box, in the picture
uniform ivec2 box;          // its size
uniform float emphasis;

vec3 code(sampler2D picture, ivec2 place) {
    ivec2 last = box - 1;
    place = abs(place);                      // mirrored about the outermost pixel
    place = min(last - abs(last - place), last);
    return texelFetch(picture, origin + max(place, ivec2(0)), 0).rgb * 255.0;
}

vec3 sharp(sampler2D picture, ivec2 place) {
    if (emphasis == 0.0) return code(picture, place);
    float middle = 1.0 + 2.0 * emphasis;
    vec3 line[3];
    for (int row = 0; row < 3; row++) {
        ivec2 at = place + ivec2(0, row - 1);
        vec3 beside = code(picture, at - ivec2(1, 0)) + code(picture, at + ivec2(1, 0));
        line[row] = middle * code(picture, at) - emphasis * beside;
    }
    return clamp(roundEven(middle * line[1] - emphasis * (line[0] + line[2])), 0.0, 255.0);
}
