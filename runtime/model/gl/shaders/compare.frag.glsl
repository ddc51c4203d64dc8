#version 330 core
// Compute the squared slope, and the error times the slope, for one ray set (docs/mathematics.md, L1 to L4).
uniform vec2 origin;
#include "places.glsl"
uniform sampler2D ahead0, ahead1, ahead2, targets, column_taper, row_taper;
uniform mat3 from_rays0, from_rays1, from_rays2;
uniform vec2 size0, size1, size2;
// turn: number of head positions, which alternate from one picture row to the next, and index of this set's position
uniform ivec2 targets_origin, turn;
layout(location = 0) out vec4 curvature;
layout(location = 1) out vec4 gradient;

// Compute the mean of exp(i pi x) over a pixel's rays with bilinear weights. Phasors are not stored between draws.
void phasor(sampler2D ahead, vec2 at, vec2 size, out vec4 re, out vec4 im) {
    ivec2 last = ivec2(size) - 1;
    vec2 corner = clamp(at, vec2(0.5), size - 0.5) - 0.5, share = fract(corner);
    re = im = vec4(0.0);
    for (int k = 0; k < 4; ++k) {
        ivec2 corner_px = ivec2(k & 1, k >> 1);
        vec2 side = mix(1.0 - share, share, vec2(corner_px));
        vec4 angle = 3.14159265 * panel(texelFetch(ahead, min(ivec2(corner) + corner_px, last), 0));
        re += side.x * side.y * cos(angle);
        im += side.x * side.y * sin(angle);
    }
}

void main() {
    vec2 at0 = place(from_rays0), at1 = place(from_rays1), at2 = place(from_rays2);
    curvature = vec4(0.0);
    gradient = held_number(vec4(0.0));
    if (!(inside(at0, size0, 0.5) && inside(at1, size1, 0.5) && inside(at2, size2, 0.5))) return;
    vec4 a, b, p, q, g, h;
    phasor(ahead0, at0, size0, a, b);
    phasor(ahead1, at1, size1, p, q);
    phasor(ahead2, at2, size2, g, h);
    vec4 re = p * g - q * h, im = p * h + q * g, slope = a * im + b * re;
    ivec2 pixel = ivec2(gl_FragCoord.x, int(gl_FragCoord.y) * turn.x + turn.y);
    vec4 target = texelFetch(targets, pixel + targets_origin, 0);
    float taper = texelFetch(column_taper, ivec2(pixel.x, 0), 0).r * texelFetch(row_taper, ivec2(pixel.y, 0), 0).r;
    vec4 error = (0.5 - 0.5 * (a * re - b * im) - target) * taper;
    curvature = slope * slope;
    gradient = held_number(error * slope);
}
