/* See external_client.h. */
#define _GNU_SOURCE
#include "external_client.h"

#include <errno.h>
#include <poll.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#define LONGEST_LINE 65536
#define NUMBERS (6 + 24) /* of a request's eyes and projections */

struct ps_display {
    int channel;
    uint8_t *memory;
    size_t bytes, first_slot, slots, slot_bytes, pixels;
    int width, height;
    uint64_t sequence;
    size_t held; /* bytes of `line` that have been received */
    char line[LONGEST_LINE + 1];
};

static void tell(char *problem, size_t size, const char *text) {
    if (problem != NULL && size > 0) snprintf(problem, size, "%s", text);
}

/* What follows `"name":` in a line of JSON; NULL where it isn't there. Only the daemon's own flat objects are read. */
static const char *value_of(const char *line, const char *name) {
    char key[64];
    snprintf(key, sizeof key, "\"%s\"", name);
    const char *found = strstr(line, key);
    if (found == NULL) return NULL;
    found += strlen(key);
    while (*found == ' ') found++;
    return *found == ':' ? found + 1 : NULL;
}

static int whole(const char *line, const char *name, size_t *value) {
    const char *text = value_of(line, name);
    char *end;
    if (text == NULL) return 0;
    while (*text == ' ') text++;
    if (*text < '0' || *text > '9') return 0;
    errno = 0;
    unsigned long long read = strtoull(text, &end, 10);
    *value = (size_t)read;
    return errno == 0 && end != text;
}

/* So many numbers of nested lists, in order. */
static int numbers(const char *line, const char *name, double *values, int count) {
    const char *text = value_of(line, name);
    if (text == NULL) return 0;
    for (int k = 0; k < count; k++) {
        char *end;
        while (*text == ' ' || *text == '[' || *text == ']' || *text == ',') text++;
        values[k] = strtod(text, &end);
        if (end == text) return 0;
        text = end;
    }
    return 1;
}

static int64_t now_ms(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000 + now.tv_nsec / 1000000;
}

static int readable(int channel, int64_t until_ms) {
    for (;;) {
        int64_t left = until_ms < 0 ? -1 : until_ms - now_ms();
        if (until_ms >= 0 && left < 0) left = 0;
        struct pollfd wanted = {channel, POLLIN, 0};
        int found = poll(&wanted, 1, (int)left);
        if (found >= 0 || errno != EINTR) return found > 0;
    }
}

/* More bytes of the line, with a descriptor where one comes; 1, 0 (gone) or -1. */
static int receive(ps_display *display, int *descriptor) {
    if (display->held >= LONGEST_LINE) return -1;
    union {
        char bytes[CMSG_SPACE(sizeof(int))];
        struct cmsghdr aligned;
    } control;
    struct iovec part = {display->line + display->held, LONGEST_LINE - display->held};
    struct msghdr message = {0};
    message.msg_iov = &part;
    message.msg_iovlen = 1;
    message.msg_control = control.bytes;
    message.msg_controllen = sizeof control.bytes;
    ssize_t got;
    do got = recvmsg(display->channel, &message, MSG_CMSG_CLOEXEC);
    while (got < 0 && errno == EINTR);
    if (got <= 0) return got == 0 || errno == ECONNRESET ? 0 : -1;
    struct cmsghdr *header = CMSG_FIRSTHDR(&message);
    if (header != NULL && header->cmsg_level == SOL_SOCKET && header->cmsg_type == SCM_RIGHTS) {
        int came;
        memcpy(&came, CMSG_DATA(header), sizeof came);
        if (descriptor != NULL && *descriptor < 0) *descriptor = came;
        else close(came);
    }
    display->held += (size_t)got;
    display->line[display->held] = '\0';
    return 1;
}

static int welcomed(ps_display *display, int descriptor, const char **why) {
    size_t version, width, height;
    struct stat status;
    *why = "no phasestack content socket, or busy";
    if (descriptor < 0 || !whole(display->line, "phasestack_content", &version) || version != 1) return 0;
    if (!whole(display->line, "width_px", &width) || !whole(display->line, "height_px", &height) ||
        !whole(display->line, "bytes", &display->bytes) || !whole(display->line, "first_slot", &display->first_slot) ||
        !whole(display->line, "slots", &display->slots) || !whole(display->line, "slot_bytes", &display->slot_bytes) ||
        !whole(display->line, "pixels", &display->pixels))
        return 0;
    *why = "its memory does not hold what it says";
    if (width == 0 || height == 0 || width > 65536 || height > 65536 || display->slots == 0 || display->slots > 16)
        return 0;
    if (display->bytes > ((size_t)1 << 40) || display->pixels > display->bytes || display->slot_bytes > display->bytes ||
        display->first_slot > display->bytes || display->pixels + 8 * width * height > display->slot_bytes ||
        display->first_slot + display->slots * display->slot_bytes > display->bytes)
        return 0;
    if (fstat(descriptor, &status) != 0 || (size_t)status.st_size < display->bytes) return 0;
    display->width = (int)width;
    display->height = (int)height;
    void *memory = mmap(NULL, display->bytes, PROT_READ | PROT_WRITE, MAP_SHARED, descriptor, 0);
    if (memory == MAP_FAILED) return 0;
    display->memory = memory;
    return 1;
}

ps_display *ps_open(const char *path, int timeout_ms, char *problem, size_t problem_size) {
    struct sockaddr_un address = {0};
    address.sun_family = AF_UNIX;
    if (strlen(path) >= sizeof address.sun_path) {
        tell(problem, problem_size, "the path is too long for a socket");
        return NULL;
    }
    strcpy(address.sun_path, path);
    ps_display *display = calloc(1, sizeof *display);
    if (display == NULL) {
        tell(problem, problem_size, "no memory");
        return NULL;
    }
    display->channel = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (display->channel < 0 || connect(display->channel, (struct sockaddr *)&address, sizeof address) != 0) {
        tell(problem, problem_size, strerror(errno));
        ps_close(display);
        return NULL;
    }
    int descriptor = -1;
    int64_t until_ms = timeout_ms < 0 ? -1 : now_ms() + timeout_ms;
    const char *why = "no answer in time";
    char *end = NULL;
    while (end == NULL && readable(display->channel, until_ms)) {
        if (receive(display, &descriptor) != 1) {
            why = "it was closed without an answer";
            break;
        }
        end = memchr(display->line, '\n', display->held);
    }
    int good = 0;
    if (end != NULL) {
        *end = '\0';
        good = welcomed(display, descriptor, &why);
        display->held -= (size_t)(end + 1 - display->line);
        memmove(display->line, end + 1, display->held);
        display->line[display->held] = '\0';
    }
    if (descriptor >= 0) close(descriptor);
    if (!good) {
        tell(problem, problem_size, why);
        ps_close(display);
        return NULL;
    }
    return display;
}

int ps_width(const ps_display *display) { return display->width; }

int ps_height(const ps_display *display) { return display->height; }

int ps_wait(ps_display *display, ps_request *request, int timeout_ms) {
    int64_t until_ms = timeout_ms < 0 ? -1 : now_ms() + timeout_ms;
    while (memchr(display->line, '\n', display->held) == NULL) {
        if (!readable(display->channel, until_ms)) return PS_TIMEOUT;
        int got = receive(display, NULL);
        if (got != 1) return got == 0 ? PS_GONE : PS_NONSENSE;
    }
    /* The newest whole line: what came before it is out of date. */
    char *last = memrchr(display->line, '\n', display->held);
    *last = '\0';
    char *before = memrchr(display->line, '\n', (size_t)(last - display->line));
    const char *line = before != NULL ? before + 1 : display->line;
    double values[NUMBERS];
    size_t number, time_ns;
    int good = whole(line, "request", &number) && whole(line, "time_ns", &time_ns) &&
               numbers(line, "eyes_m", values, 6) && numbers(line, "pixels_from_stack", values + 6, 24);
    if (good) {
        request->number = number;
        request->time_ns = (int64_t)time_ns;
        memcpy(request->eyes_m, values, sizeof request->eyes_m);
        memcpy(request->pixels_from_stack, values + 6, sizeof request->pixels_from_stack);
    }
    display->held -= (size_t)(last + 1 - display->line);
    memmove(display->line, last + 1, display->held);
    display->line[display->held] = '\0';
    return good ? PS_OK : PS_NONSENSE;
}

static uint8_t *slot_of(ps_display *display) {
    return display->memory + display->first_slot + (display->sequence % display->slots) * display->slot_bytes;
}

void ps_begin(ps_display *display, const ps_request *request) {
    display->sequence++;
    uint8_t *slot = slot_of(display);
    memcpy(slot, &display->sequence, 8); /* the protocol's numbers are little-endian: so are Linux's machines here */
    memcpy(slot + 16, &request->number, 8);
    atomic_thread_fence(memory_order_release);
}

uint8_t *ps_picture(ps_display *display, int eye) {
    size_t size = (size_t)display->width * (size_t)display->height * 4;
    return slot_of(display) + display->pixels + (eye != 0 ? size : 0);
}

void ps_send(ps_display *display) {
    atomic_thread_fence(memory_order_release);
    memcpy(slot_of(display) + 8, &display->sequence, 8);
}

void ps_close(ps_display *display) {
    if (display == NULL) return;
    if (display->memory != NULL) munmap(display->memory, display->bytes);
    if (display->channel >= 0) close(display->channel);
    free(display);
}
