#version 330 core
// One image as it is, to measure what reading and writing cost.
uniform isampler2D image;
out ivec4 copied;
void main() {
    copied = texelFetch(image, ivec2(gl_FragCoord.xy), 0);
}
