#version 330 core
// An outer panel from another raster: the network's, or a coarser one of the same box.
uniform isampler2D image;
uniform ivec2 size;
uniform mat3 image_from_panel;
uniform int outside;
out ivec4 panel;
#include "sample.glsl"
#include "columns.glsl"
#include "cubic.glsl"
#include "shown.glsl"

void main() {
    vec2 place = moved(image_from_panel, gl_FragCoord.xy);
    place.x = column_from_homography(place.x);
    if (bend != 0.0) panel = kept(cubic(image, size, place));
    else if (sheared(image_from_panel)) panel = kept(bilinear(image, size, place));
    else panel = kept(beside(place, size) ? ivec4(outside) : cubic(image, size, place));
}
