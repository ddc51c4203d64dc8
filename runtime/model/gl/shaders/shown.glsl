// Within a panel's range, about its middle; what will be shown is rounded to what 8 bits can show.
uniform bool shown;

ivec4 kept(ivec4 codes) {
    if (shown) codes = ((codes + even + 8) & -16) - even;
    return clamp(codes, -even, even);
}
