// How a part of larger panels ends: nothing beyond `kept_box` (left, top, right, bottom) drives the panels.
uniform vec4 kept_box;
uniform vec4 over;              // pixels over which each side fades; 0: it does not
uniform vec4 centre_from_here;  // the whole centre panel's pixels: scale, shift

float share(ivec2 place) {
    if (over == vec4(0.0)) return 1.0;
    vec2 at = (vec2(place) + 0.5) * centre_from_here.xy + centre_from_here.zw;
    float inside[4] = float[4](at.x - kept_box.x, kept_box.z - at.x, at.y - kept_box.y, kept_box.w - at.y);
    float reach[4] = float[4](over.x, over.z, over.y, over.w);
    float least = 1.0;
    for (int side = 0; side < 4; side++)
        if (reach[side] > 0.0) least = min(least, clamp(inside[side] / reach[side], 0.0, 1.0));
    return least;
}
