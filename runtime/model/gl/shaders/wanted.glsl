// The phase sums that the eyes want: held as 8-bit codes, and looked up in a table.
uniform sampler2D wanted_left, wanted_right;
uniform isampler2D table;   // 256 phases
uniform bool grey;

ivec4 phases(sampler2D wanted, ivec2 place) {
    ivec3 codes = ivec3(texelFetch(wanted, place, 0).rgb * 255.0 + 0.5);
    int red = texelFetch(table, ivec2(codes.r, 0), 0).r;
    if (grey) return ivec4(red);
    return ivec4(red, texelFetch(table, ivec2(codes.g, 0), 0).r, texelFetch(table, ivec2(codes.b, 0), 0).r, 0);
}
