#version 330 core
// An outer panel from a coarser raster of the same box.
#include "sample.glsl"
#include "cubic.glsl"
#include "shown.glsl"
uniform IMAGE image;
uniform ivec2 size;
uniform vec2 image_from_panel;  // scale
out STORED panel;

void main() {
    panel = kept(cubic(image, size, gl_FragCoord.xy * image_from_panel));
}
