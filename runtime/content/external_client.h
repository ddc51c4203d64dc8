/* A small client for programs in C or C++ that draw phasestack's pictures. Linux; the C library and nothing else.
 *
 *     char problem[256];
 *     ps_display *display = ps_open("/run/phasestack/content.sock", 10000, problem, sizeof problem);
 *     ps_request request;
 *     while (display != NULL && ps_wait(display, &request, 10000) == PS_OK) {
 *         ps_begin(display, &request);
 *         draw(ps_picture(display, 0), ps_picture(display, 1), &request);
 *         ps_send(display);
 *     }
 *     ps_close(display);
 *
 * Both files may be copied out of this project; docs/external-content.md is the protocol. One thread uses a display.
 */
#ifndef PHASESTACK_EXTERNAL_CLIENT_H
#define PHASESTACK_EXTERNAL_CLIENT_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct ps_display ps_display;

typedef struct {
    uint64_t number;
    int64_t time_ns;                    /* the daemon's clock */
    double eyes_m[2][3];                /* left, right; metres; +x towards the viewer, +y right, +z up */
    double pixels_from_stack[2][3][4];  /* pixel (u, v) = first two of P (x, y, z, 1) over the third; v down */
} ps_request;

enum { PS_OK = 1, PS_GONE = 0, PS_TIMEOUT = -1, PS_NONSENSE = -2 };

/* Connects. NULL where there is no daemon, it is busy, or it speaks otherwise: `problem` then holds one line. */
ps_display *ps_open(const char *path, int timeout_ms, char *problem, size_t problem_size);

/* Size of each eye's picture. */
int ps_width(const ps_display *display);
int ps_height(const ps_display *display);

/* Waits for eyes to draw for: PS_OK and the newest request, PS_GONE (the daemon has left), PS_TIMEOUT, PS_NONSENSE.
 * A timeout below 0 waits for ever. */
int ps_wait(ps_display *display, ps_request *request, int timeout_ms);

/* Begins both pictures of a request. */
void ps_begin(ps_display *display, const ps_request *request);

/* The picture of an eye (0: left, 1: right), to be drawn into between ps_begin and ps_send: ps_height rows of ps_width
 * pixels, RGBA, 8 bits, row 0 at the top, composed over the background, alpha 0 where only that shows. All of it must
 * be written: it holds an earlier picture. */
uint8_t *ps_picture(ps_display *display, int eye);

/* Hands both over. The daemon never waits for it, and never shows a half. */
void ps_send(ps_display *display);

void ps_close(ps_display *display);

#ifdef __cplusplus
}
#endif
#endif
