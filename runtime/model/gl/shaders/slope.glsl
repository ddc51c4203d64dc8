// A ray weighs by the slope of sin^2 at the phase sum that is wanted of it: before white and black that is
// level, so that errors there are not seen.
const float FLOOR = 0.25;   // the least weight, as `targets.SLOPE_FLOOR`

struct Weighed {
    vec4 lacks, slope;      // what an eye lacks, times its weight; the weight
};

const Weighed BESIDE = Weighed(vec4(0.0), vec4(1.0));  // the centre panel

vec4 slope(ivec4 phase) {
    vec4 part = fract(vec4(phase) / float(2 * even));
    return FLOOR + (1.0 - FLOOR) * 4.0 * part * (1.0 - part);
}

// The best centre panel for what both eyes lack there.
vec4 weighed_best(ivec4 left, ivec4 right, vec4 left_slope, vec4 right_slope) {
    vec4 mean = (left_slope * vec4(left) + right_slope * vec4(right)) / (left_slope + right_slope);
    return clamp(mean, 0.0, float(2 * even));
}

// One of the four pixels around a place, `weight` beyond the first of them, joins what is there.
void join(inout Weighed sum, ivec2 corner, vec2 weight, vec4 lacks, vec4 slope) {
    vec2 share = mix(1.0 - weight, weight, vec2(corner));
    sum.lacks += share.x * share.y * slope * lacks;
    sum.slope += share.x * share.y * slope;
}

vec4 answered(Weighed left, Weighed right) {
    return 2.0 * (left.lacks + right.lacks) / (left.slope + right.slope);
}

ivec4 times(ivec4 lacks, float share) {
    return rounded(vec4(lacks) * share);
}
