#version 330 core
// `correct` for eyes that are unsure: in the mean over where they may be, less what moves of the panel itself.
uniform isampler2D panel;
uniform isampler2D half_blurred_lacks, half_blurred_mean;  // blurred across
uniform int eighths;
out ivec4 corrected;
#include "sample.glsl"
#include "blur.glsl"
#include "shown.glsl"

void main() {
    ivec4 outer = texelFetch(panel, ivec2(gl_FragCoord.xy), 0);
    ivec4 noise = outer - blurred(half_blurred_mean);
    corrected = kept(outer + ((blurred(half_blurred_lacks) - 2 * noise) >> 3) * eighths);
}
