/* Closed-loop Modbus TCP load on controllers that tell when they were read (line_simulator.py).
 *
 *   line_load PORT CONNECTIONS SECONDS UNITS TIMEOUT_S
 *
 * Each connection asks function 03, 80 registers from 0, of units 1..UNITS in turn, one request at a time, and waits
 * TIMEOUT_S for the reply; after that it counts a time-out and connects anew, as clients do. Every reply is checked
 * whole: transaction id, unit, length, function, byte count, and that registers 2 to 79 are that unit's. Registers 0
 * and 1 give the age of the values. Prints one line of JSON; percentiles are of good replies.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { REGISTERS = 80, REPLY = 9 + 2 * REGISTERS, REFUSAL = 9, BUCKETS = 20000000 };

struct peer {
    int fd, unit;
    uint16_t tid;
    double sent;
    unsigned char in[512];
    size_t have;
};

static unsigned latency_us[BUCKETS];
static unsigned long replies, wrong, timeouts, closed, refusals[256];
static uint32_t oldest_ms;
static int port, units, poller;

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec / 1e9;
}

static void ask(struct peer *p) {
    p->unit = p->unit % units + 1;
    p->tid++;
    p->have = 0;
    unsigned char r[12] = {p->tid >> 8, p->tid & 255, 0, 0, 0, 6, p->unit, 3, 0, 0, 0, REGISTERS};
    p->sent = now();
    if (send(p->fd, r, sizeof r, MSG_NOSIGNAL) != sizeof r)
        p->sent = 0; /* lost: times out at once */
}

static void connect_peer(struct peer *p) {
    struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons(port)};
    to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    int one = 1;
    if (p->fd >= 0)
        close(p->fd);
    p->fd = socket(AF_INET, SOCK_STREAM, 0);
    if (connect(p->fd, (struct sockaddr *)&to, sizeof to)) {
        perror("connect");
        exit(1);
    }
    setsockopt(p->fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
    struct epoll_event e = {.events = EPOLLIN, .data.ptr = p};
    epoll_ctl(poller, EPOLL_CTL_ADD, p->fd, &e);
    ask(p);
}

static int good(const struct peer *p, size_t size) {
    const unsigned char *r = p->in;
    if ((r[0] << 8 | r[1]) != p->tid || r[6] != p->unit)
        return 0;
    if (size == REFUSAL && r[7] == 0x83) {
        refusals[r[8]]++;
        return 2;
    }
    if (size != REPLY || r[7] != 3 || r[8] != 2 * REGISTERS)
        return 0;
    for (int i = 2; i < REGISTERS; i++)
        if (r[9 + 2 * i] != p->unit || r[10 + 2 * i] != i)
            return 0;
    uint32_t held = (uint32_t)r[9] << 24 | r[10] << 16 | r[11] << 8 | r[12];
    uint32_t age = (uint32_t)(uint64_t)(now() * 1000) - held;
    if ((int32_t)age > (int32_t)oldest_ms)
        oldest_ms = age;
    return 1;
}

static void take(struct peer *p) {
    ssize_t n = recv(p->fd, p->in + p->have, sizeof p->in - p->have, MSG_DONTWAIT);
    if (n == 0) {
        closed++;
        connect_peer(p);
        return;
    }
    if (n < 0)
        return;
    p->have += n;
    if (p->have < 6)
        return;
    size_t size = 6 + (p->in[4] << 8 | p->in[5]);
    if (p->have < size)
        return;
    int kind = p->have == size ? good(p, size) : 0;
    if (kind == 0)
        wrong++;
    if (kind == 1) {
        double us = (now() - p->sent) * 1e6;
        latency_us[us < BUCKETS - 1 ? (int)us : BUCKETS - 1]++;
        replies++;
    }
    ask(p);
}

static unsigned percentile(double share) {
    unsigned long seen = 0;
    for (unsigned us = 0; us < BUCKETS; us++)
        if ((seen += latency_us[us]) > share * replies)
            return us;
    return 0;
}

int main(int argc, char **argv) {
    if (argc != 6) {
        fprintf(stderr, "usage: %s PORT CONNECTIONS SECONDS UNITS TIMEOUT_S\n", argv[0]);
        return 2;
    }
    port = atoi(argv[1]);
    units = atoi(argv[4]);
    int connections = atoi(argv[2]);
    double seconds = atof(argv[3]), timeout_s = atof(argv[5]);
    poller = epoll_create1(0);
    struct peer *peers = calloc(connections, sizeof *peers);
    double began = now();
    for (int i = 0; i < connections; i++) {
        peers[i].fd = -1;
        peers[i].unit = i % units;
        connect_peer(&peers[i]);
    }
    for (double t = began; t - began < seconds; t = now()) {
        struct epoll_event events[64];
        int n = epoll_wait(poller, events, 64, 50);
        for (int i = 0; i < n; i++)
            take(events[i].data.ptr);
        t = now();
        for (int i = 0; i < connections; i++)
            if (t - peers[i].sent > timeout_s) {
                timeouts++;
                connect_peer(&peers[i]);
            }
    }
    unsigned long refused = 0;
    printf("{\"refusals\": {");
    for (int code = 0; code < 256; code++)
        if (refusals[code])
            printf("%s\"%02X\": %lu", refused ? ", " : "", code, refusals[code]), refused += refusals[code];
    printf("}, \"replies\": %lu, \"wrong\": %lu, \"timeouts\": %lu, \"closed\": %lu, \"seconds\": %.3f, \"p50_us\": %u, "
           "\"p95_us\": %u, \"p99_us\": %u, \"oldest_ms\": %u}\n",
           replies, wrong, timeouts, closed, now() - began, percentile(0.5), percentile(0.95), percentile(0.99),
           oldest_ms);
    return 0;
}
