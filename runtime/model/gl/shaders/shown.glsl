// Within a panel's range, about its middle; what will be shown is rounded to what 8 bits can show.
uniform bool shown;

STORED kept(ivec4 codes) {
    if (shown) codes = ((codes + even + 8) & -16) - even;
    return stored(vec4(clamp(codes, -even, even)));
}
