#version 330 core
// One set of rays: the squared slope, and for every panel the error times the other panels' phasors (L1 to L4).
uniform vec2 origin;
#include "places.glsl"
uniform sampler2D cosine0, sine0, cosine1, sine1, cosine2, sine2, wanted, column_taper, row_taper;
uniform mat3 from_rays0, from_rays1, from_rays2;
uniform vec2 size0, size1, size2;
uniform ivec2 wanted_origin;
layout(location = 0) out vec4 curvature;
layout(location = 1) out vec4 real0;
layout(location = 2) out vec4 imaginary0;
layout(location = 3) out vec4 real1;
layout(location = 4) out vec4 imaginary1;
layout(location = 5) out vec4 real2;
layout(location = 6) out vec4 imaginary2;

void main() {
    vec2 at0 = place(from_rays0), at1 = place(from_rays1), at2 = place(from_rays2);
    curvature = vec4(0.0);
    real0 = imaginary0 = real1 = imaginary1 = real2 = imaginary2 = held_number(vec4(0.0));
    if (!(inside(at0, size0, 0.5) && inside(at1, size1, 0.5) && inside(at2, size2, 0.5))) return;
    vec4 a = signed_number(sampled(cosine0, at0, size0)), b = signed_number(sampled(sine0, at0, size0));
    vec4 p = signed_number(sampled(cosine1, at1, size1)), q = signed_number(sampled(sine1, at1, size1));
    vec4 g = signed_number(sampled(cosine2, at2, size2)), h = signed_number(sampled(sine2, at2, size2));
    vec4 re = p * g - q * h, im = p * h + q * g, slope = a * im + b * re;
    vec4 target = texelFetch(wanted, ivec2(gl_FragCoord.xy) + wanted_origin, 0);
    float taper = texelFetch(column_taper, ivec2(gl_FragCoord.x, 0), 0).r * texelFetch(row_taper, ivec2(gl_FragCoord.y, 0), 0).r;
    vec4 error = (0.5 - 0.5 * (a * re - b * im) - target) * taper;
    curvature = slope * slope;
    real0 = held_number(error * re);
    imaginary0 = held_number(error * im);
    real1 = held_number(error * (a * g - b * h));
    imaginary1 = held_number(error * (a * h + b * g));
    real2 = held_number(error * (a * p - b * q));
    imaginary2 = held_number(error * (a * q + b * p));
}
