/* A program in C that draws phasestack's pictures: three squares at three depths.
 *
 * Start the daemon with `phasestack run --scene external`, then:
 *
 *     cc -O2 -Iruntime/content examples/external_squares.c runtime/content/external_client.c -o squares
 *     ./squares /run/phasestack/content.sock [frames]
 */
#include "external_client.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    double x, y, z, half;
    uint8_t colour[3];
} square;

static const square SQUARES[] = {
    {-0.05, -0.10, 0.0, 0.05, {30, 90, 200}},
    {0.0, 0.0, 0.0, 0.05, {40, 160, 60}},
    {0.05, 0.10, 0.0, 0.05, {220, 60, 40}}, /* farthest first: what is nearer hides it */
};

static void project(double matrix[3][4], double x, double y, double z, double *u, double *v) {
    double p[3];
    for (int row = 0; row < 3; row++)
        p[row] = matrix[row][0] * x + matrix[row][1] * y + matrix[row][2] * z + matrix[row][3];
    *u = p[0] / p[2];
    *v = p[1] / p[2];
}

static int within(double value, int most) { return value < 0 ? 0 : value > most ? most : (int)(value + 0.5); }

/* Squares parallel to the panels stay upright in the panels' pixels. */
static void draw(uint8_t *picture, int width, int height, double matrix[3][4]) {
    for (size_t k = 0; k < (size_t)width * (size_t)height; k++) memcpy(picture + 4 * k, "\xff\xff\xff\0", 4);
    for (size_t number = 0; number < sizeof SQUARES / sizeof *SQUARES; number++) {
        const square *s = &SQUARES[number];
        double left, top, right, bottom;
        project(matrix, s->x, s->y - s->half, s->z + s->half, &left, &top);
        project(matrix, s->x, s->y + s->half, s->z - s->half, &right, &bottom);
        for (int row = within(top, height); row < within(bottom, height); row++)
            for (int column = within(left, width); column < within(right, width); column++) {
                uint8_t *pixel = picture + 4 * ((size_t)row * (size_t)width + (size_t)column);
                memcpy(pixel, s->colour, 3);
                pixel[3] = 255;
            }
    }
}

int main(int count, char **arguments) {
    char problem[256];
    long frames = count > 2 ? strtol(arguments[2], NULL, 10) : -1;
    ps_display *display = ps_open(count > 1 ? arguments[1] : "/run/phasestack/content.sock", 10000, problem, sizeof problem);
    if (display == NULL) {
        fprintf(stderr, "squares: %s\n", problem);
        return 1;
    }
    ps_request request;
    int found = PS_OK;
    while (frames != 0 && (found = ps_wait(display, &request, 10000)) == PS_OK) {
        ps_begin(display, &request);
        for (int eye = 0; eye < 2; eye++)
            draw(ps_picture(display, eye), ps_width(display), ps_height(display), request.pixels_from_stack[eye]);
        ps_send(display);
        frames--;
    }
    ps_close(display);
    return found == PS_OK || found == PS_GONE ? 0 : 1;
}
