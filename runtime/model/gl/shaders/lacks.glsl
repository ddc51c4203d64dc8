// What each eye lacks at a pixel of the centre panel when that panel is the best one for the outer ones.
uniform isampler2D rear, front;
uniform ivec2 rear_size, front_size;
uniform mat3 rear_from_left, rear_from_right, front_from_left, front_from_right;  // from the centre's pixels
// How a part of larger panels ends: nothing beyond `kept_box` (left, top, right, bottom) drives the panels.
uniform vec4 kept_box;
uniform vec4 over;              // pixels over which each side fades; 0: it does not
uniform vec4 centre_from_here;  // the whole centre panel's pixels: scale, shift

struct Look {
    ivec4 left, right;  // what the eyes lack
    ivec4 rear_left, rear_right, front_left, front_right;  // how they see the outer panels
    vec4 left_slope, right_slope;  // what they weigh; not yet in what they lack, which is rounded
};

ivec4 faded(ivec4 value, ivec2 place) {
    if (over == vec4(0.0)) return value;
    vec2 at = (vec2(place) + 0.5) * centre_from_here.xy + centre_from_here.zw;
    float inside[4] = float[4](at.x - kept_box.x, kept_box.z - at.x, at.y - kept_box.y, kept_box.w - at.y);
    float reach[4] = float[4](over.x, over.z, over.y, over.w);
    for (int side = 0; side < 4; side++)
        if (reach[side] > 0.0) value = (value * int(clamp(roundEven(inside[side] / reach[side] * 4.0), 0.0, 4.0))) >> 2;
    return value;
}

Look look(ivec2 place) {
    Look found;
    vec2 at = vec2(place) + 0.5;
    found.rear_left = crossed(rear, rear_size, rear_from_left, at);
    found.rear_right = crossed(rear, rear_size, rear_from_right, at);
    found.front_left = crossed(front, front_size, front_from_left, at);
    found.front_right = crossed(front, front_size, front_from_right, at);
    ivec4 left_wanted = phases(wanted_left, place), right_wanted = phases(wanted_right, place);
    ivec4 left = left_wanted - 2 * even - found.rear_left - found.front_left;
    ivec4 right = right_wanted - 2 * even - found.rear_right - found.front_right;
    found.left_slope = slope(left_wanted);
    found.right_slope = slope(right_wanted);
    ivec4 best = rounded(weighed_best(left, right, found.left_slope, found.right_slope));
    found.left = faded(left - best, place);
    found.right = faded(right - best, place);
    return found;
}
