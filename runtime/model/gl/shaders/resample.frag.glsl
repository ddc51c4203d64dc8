#version 330 core
// An outer panel as the network wants it, from the network's raster.
#include "sample.glsl"
#include "columns.glsl"
#include "cubic.glsl"
#include "shown.glsl"
uniform isampler2D image;   // codes from 0 on
uniform ivec2 size;
uniform mat3 image_from_panel;
out ivec4 panel;

void main() {
    vec2 place = moved(image_from_panel, gl_FragCoord.xy);
    place.x = column_from_homography(place.x);
    bool skew = bend == 0.0 && sheared(image_from_panel);
    if (bend == 0.0 && !skew && beside(place, size)) panel = kept(ivec4(0));
    else panel = kept((skew ? bilinear(image, size, place) : cubic(image, size, place)) - even);
}
