#version 330 core
// Compute the squared slope, and the error times the slope, for one ray set (docs/mathematics.md, L1 to L4).
uniform vec2 origin;
#include "places.glsl"
uniform sampler2D targets, column_taper, row_taper;
#for PANELS
uniform sampler2D ahead@;
uniform mat3 from_rays@;
uniform vec2 size@;
#end
// turn: number of turns that sets take from one picture row to the next, and this set's turn
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
    curvature = vec4(0.0);
    gradient = held_number(vec4(0.0));
#for PANELS
    vec2 at@ = place(from_rays@);
    if (!inside(at@, size@, 0.5)) return;
#end
    vec4 re = vec4(1.0), im = vec4(0.0), a, b, product;
#for PANELS
    phasor(ahead@, at@, size@, a, b);
    product = re * a - im * b;
    im = re * b + im * a;
    re = product;
#end
    ivec2 pixel = ivec2(gl_FragCoord.x, int(gl_FragCoord.y) * turn.x + turn.y);
    vec4 target = texelFetch(targets, pixel + targets_origin, 0);
    float taper = texelFetch(column_taper, ivec2(pixel.x, 0), 0).r * texelFetch(row_taper, ivec2(pixel.y, 0), 0).r;
    vec4 error = (0.5 - 0.5 * re - target) * taper;
    curvature = im * im;
    gradient = held_number(error * im);
}
