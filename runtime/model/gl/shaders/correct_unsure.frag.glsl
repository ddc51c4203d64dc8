#version 330 core
// `correct` for eyes that are unsure: in the mean over where they may be, less what moves of the panel itself.
#include "sample.glsl"
#include "blur.glsl"
#include "slope.glsl"
#include "shown.glsl"
uniform isampler2D panel, mean;
uniform isampler2D half_blurred; // `back`, blurred across
uniform float share;        // of what is lacked
out ivec4 corrected;

void main() {
    ivec2 place = ivec2(gl_FragCoord.xy);
    ivec4 outer = value(panel, place);
    ivec4 change = rounded(blurred(half_blurred)) + 2 * (value(mean, place) - outer);
    corrected = kept(outer + times(change, share));
}
