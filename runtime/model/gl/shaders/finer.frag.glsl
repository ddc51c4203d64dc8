#version 330 core
// An outer panel from a coarser raster of the same box.
#include "sample.glsl"
#include "cubic.glsl"
#include "shown.glsl"
uniform isampler2D image;
uniform ivec2 size;
uniform vec2 image_from_panel;  // scale
out ivec4 panel;

void main() {
    panel = kept(cubic(image, size, gl_FragCoord.xy * image_from_panel));
}
