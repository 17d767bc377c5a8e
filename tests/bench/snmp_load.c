/* Closed-loop SNMP load: `snmp_load PORT SOCKETS SECONDS FILE`.
 *
 * FILE holds ready requests (snmp_message.h). Every socket sends one, waits for its reply, and
 * sends the next; all sockets take turns in the file, over and over. A reply must be one message of the version of
 * its request with the same id (request-id, or msgID in SNMPv3) and, up to v2c, error-status 0; anything else is
 * "wrong". A request without a reply within a second is "lost". Prints one line of JSON.
 */
#include <arpa/inet.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "snmp_message.h"

#define MOST_SOCKETS 64
#define TIMEOUT_S 1.0

static float *times;
static size_t replies, room, varbinds, octets;

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec * 1e-9;
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
