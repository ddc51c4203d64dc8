#version 330 core
// An outer panel from another raster: the network's, or a coarser one of the same box.
uniform isampler2D image;
uniform ivec2 size;
uniform mat3 image_from_panel;
uniform bool sheared;
uniform int outside;
out ivec4 panel;
#include "sample.glsl"
#include "cubic.glsl"
#include "shown.glsl"

void main() {
    vec2 place = (image_from_panel * vec3(gl_FragCoord.xy, 1.0)).xy;
    if (sheared) panel = kept(bilinear(image, size, place));
    else panel = kept(beside(place, size) ? ivec4(outside) : cubic(image, size, place));
}
