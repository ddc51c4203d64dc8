#version 330 core
// A picture or layer with rows for columns.
uniform sampler2D image;
out vec4 turned;

void main() {
    turned = texelFetch(image, ivec2(gl_FragCoord.yx), 0);
}
