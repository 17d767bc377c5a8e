/* Closed-loop SNMP load: `snmp_load PORT SOCKETS SECONDS FILE`.
 *
 * FILE holds ready requests, each behind its length in two octets. Every socket sends one, waits for its reply, and
 * sends the next; all sockets take turns in the file, over and over. A reply must be one message of the version of
 * its request with the same id (request-id, or msgID in SNMPv3) and, up to v2c, error-status 0; anything else is
 * "wrong". A request without a reply within a second is "lost". Prints one line of JSON.
 */
#include <arpa/inet.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define MOST_SOCKETS 64
#define TIMEOUT_S 1.0

struct request { const uint8_t *data; int size; uint32_t id; int version; };

static struct request *requests;
static size_t many;
static float *times;
static size_t replies, room, varbinds, octets;

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec * 1e-9;
}

/* The content of the value at *at, which has this tag: its size, and *at moved to where it begins; -1 when it has not. */
static int enter(const uint8_t *data, int end, int *at, int tag)
{
    int size, octets_of_size;

    if (*at + 2 > end || data[*at] != tag)
        return -1;
    size = data[*at + 1];
    *at += 2;
    if (size & 0x80) {
        octets_of_size = size & 0x7f;
        if (octets_of_size > 2 || *at + octets_of_size > end)
            return -1;
        for (size = 0; octets_of_size; octets_of_size--)
            size = size << 8 | data[(*at)++];
    }
    return *at + size > end ? -1 : size;
}

static int number(const uint8_t *data, int end, int *at, uint32_t *value)
{
    int size = enter(data, end, at, 0x02);

    if (size < 1 || size > 4)
        return -1;
    for (*value = 0; size; size--)
        *value = *value << 8 | data[(*at)++];
    return 0;
}

/* Version and id of a message; for a response its error status, and its varbinds counted. 0 when it is right. */
static int look(const uint8_t *data, int end, int *version, uint32_t *id, uint32_t *status, size_t *count)
{
    int at = 0, size = enter(data, end, &at, 0x30);
    uint32_t value;

    *status = 0;
    if (size < 0 || at + size != end || number(data, end, &at, &value))
        return -1;
    *version = value;
    if (*version == 3)
        return enter(data, end, &at, 0x30) < 0 || number(data, end, &at, id) ? -1 : 0;
    size = enter(data, end, &at, 0x04);
    if (size < 0)
        return -1;
    at += size;
    if (at >= end || enter(data, end, &at, data[at]) < 0 || number(data, end, &at, id))
        return -1;
    if (number(data, end, &at, status) || number(data, end, &at, &value) || enter(data, end, &at, 0x30) < 0)
        return -1;
    for (*count = 0; at < end; ++*count) {
        size = enter(data, end, &at, 0x30);
        if (size < 0)
            return -1;
        at += size;
    }
    return 0;
}

static void load(const char *path)
{
    FILE *file = fopen(path, "rb");
    static uint8_t buffer[1 << 24];
    size_t size, at, count;
    uint32_t status;

    if (!file || !(size = fread(buffer, 1, sizeof buffer, file)) || size == sizeof buffer) {
        perror(path);
        exit(1);
    }
    fclose(file);
    requests = calloc(size / 8 + 1, sizeof *requests);
    for (at = 0; at + 2 < size; many++) {
        struct request *one = &requests[many];

        one->size = buffer[at] << 8 | buffer[at + 1];
        one->data = buffer + at + 2;
        at += 2 + one->size;
        if (at > size || look(one->data, one->size, &one->version, &one->id, &status, &count)) {
            fprintf(stderr, "%s: no request at %zu\n", path, at);
            exit(1);
        }
    }
}

static int by_size(const void *a, const void *b)
{
    float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

int main(int argc, char **argv)
{
    struct pollfd fds[MOST_SOCKETS];
    size_t under_way[MOST_SOCKETS], next = 0, lost = 0, wrong = 0;
    double sent_at[MOST_SOCKETS], start, until, t;
    int sockets, i;

    if (argc != 5 || (sockets = atoi(argv[2])) < 1 || sockets > MOST_SOCKETS) {
        fprintf(stderr, "usage: snmp_load PORT SOCKETS SECONDS FILE\n");
        return 1;
    }
    load(argv[4]);
    for (i = 0; i < sockets; i++) {
        struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons(atoi(argv[1]))};

        to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        fds[i].fd = socket(AF_INET, SOCK_DGRAM, 0);
        fds[i].events = POLLIN;
        if (fds[i].fd < 0 || connect(fds[i].fd, (struct sockaddr *)&to, sizeof to)) {
            perror("connect");
            return 1;
        }
    }
    start = now();
    until = start + atof(argv[3]);
    for (i = 0; i < sockets; i++) {
        under_way[i] = next++ % many;
        sent_at[i] = now();
        send(fds[i].fd, requests[under_way[i]].data, requests[under_way[i]].size, 0);
    }
    while ((t = now()) < until) {
        poll(fds, sockets, 0);
        t = now();
        for (i = 0; i < sockets; i++) {
            struct request *one = &requests[under_way[i]];
            uint8_t reply[4096];
            uint32_t id, status;
            size_t count = 0;
            int version;
            ssize_t size;

            if (fds[i].revents) {
                size = recv(fds[i].fd, reply, sizeof reply, MSG_DONTWAIT);
                if (size < 0)
                    continue;
                if (look(reply, size, &version, &id, &status, &count) || version != one->version ||
                    id != one->id || status) {
                    wrong++;
                    continue;
                }
                if (replies == room) {
                    room = room ? 2 * room : 1 << 16;
                    times = realloc(times, room * sizeof *times);
                }
                times[replies++] = t - sent_at[i];
                varbinds += count;
                octets += size;
            } else if (t - sent_at[i] > TIMEOUT_S) {
                lost++;
            } else {
                continue;
            }
            under_way[i] = next++ % many;
            one = &requests[under_way[i]];
            sent_at[i] = now();
            send(fds[i].fd, one->data, one->size, 0);
        }
    }
    qsort(times, replies, sizeof *times, by_size);
    printf("{\"replies\": %zu, \"seconds\": %.6f, \"p50_us\": %.0f, \"p99_us\": %.0f, \"lost\": %zu, \"wrong\": %zu, "
           "\"varbinds\": %zu, \"octets\": %zu}\n",
           replies, t - start, replies ? times[replies / 2] * 1e6 : 0,
           replies ? times[(size_t)(replies * 0.99)] * 1e6 : 0, lost, wrong, varbinds, octets);
    return 0;
}
