// Within a panel's range; what will be shown is rounded to what 8 bits can show.
uniform bool shown;
ivec4 kept(ivec4 codes) {
    if (shown) codes = (codes + 8) & -16;
    return clamp(codes, 0, 4080);
}
