/* Closed-loop Modbus TCP load: CONNECTIONS sockets, each with DEPTH requests under way, for SECONDS.
 *
 *   modbus_load PORT CONNECTIONS DEPTH SECONDS UNITS [WALKERS SNMP_PORT FILE [HTTP_PORT ENCODING]]
 *
 * Asks function 03, 80 registers from 0, of units 1..UNITS in turn, and checks every reply whole: transaction
 * id in order, unit, length, function, byte count, and that register i holds i. Prints one line of JSON.
 *
 * With more arguments the same process asks for other things meanwhile, and never pauses: WALKERS sockets send the SNMP
 * requests of FILE (snmp_message.h), one under way for each; one client scrapes /metrics, a connection a scrape. They
 * are here, and not in a process of their own, because two generators on one core wait for each other by the
 * scheduler's slice, which is 3 ms of latency that no server has caused.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
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

#include "snmp_message.h"

enum { MODBUS, WALKER, SCRAPER };
enum { REGISTERS = 80, REQUEST = 12, REPLY = 9 + 2 * REGISTERS, MAX_DEPTH = 64, BUCKETS = 2000000 };

struct peer {
    int what, fd, depth, unit;
    uint16_t next_tid, due_tid;
    double sent[MAX_DEPTH];
    unsigned char in[REPLY * MAX_DEPTH * 2];
    size_t have;
};

static unsigned char expected[2 * REGISTERS];
static unsigned latency_us[BUCKETS]; /* latency_us[i]: replies that took i microseconds */
static unsigned long replies, wrong;

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec / 1e9;
}

static void ask(struct peer *p, int count) {
    unsigned char out[REQUEST * MAX_DEPTH];
    double at = now();
    for (int i = 0; i < count; i++) {
        unsigned char r[REQUEST] = {p->next_tid >> 8, p->next_tid & 255, 0, 0, 0, 6, p->unit, 3, 0, 0, 0, REGISTERS};
        memcpy(out + i * REQUEST, r, REQUEST);
        p->sent[p->next_tid % MAX_DEPTH] = at;
        p->next_tid++;
    }
    if (send(p->fd, out, count * REQUEST, MSG_NOSIGNAL) != count * REQUEST) {
        perror("send");
        exit(1);
    }
}

/* Takes what came; returns how many replies that was, or -1 when the server closed. */
static int take(struct peer *p) {
    ssize_t n = recv(p->fd, p->in + p->have, sizeof p->in - p->have, MSG_DONTWAIT);
    if (n <= 0)
        return n < 0 && errno == EAGAIN ? 0 : -1;
    p->have += n;
    int count = 0;
    size_t at = 0;
    double t = now();
    while (p->have - at >= 6) {
        unsigned char *r = p->in + at;
        size_t size = 6 + (r[4] << 8 | r[5]);
        if (p->have - at < size)
            break;
        uint16_t tid = r[0] << 8 | r[1];
        if (tid != p->due_tid || size != REPLY || r[6] != p->unit || r[7] != 3 || r[8] != 2 * REGISTERS ||
            memcmp(r + 9, expected, sizeof expected))
            wrong++;
        double us = (t - p->sent[tid % MAX_DEPTH]) * 1e6;
        latency_us[us < BUCKETS - 1 ? (int)us : BUCKETS - 1]++;
        p->due_tid = tid + 1;
        replies++;
        count++;
        at += size;
    }
    memmove(p->in, p->in + at, p->have - at);
    p->have -= at;
    return count;
}

/* One that asks for something else. */
struct other {
    int what, fd;
    size_t under_way;
    double sent;
};

static size_t next_request, walked, varbinds, not_walked, scrapes, scraped;
static char scrape_request[128];
static struct sockaddr_in snmp_address, http_address;

static void walk_on(struct other *o) {
    struct request *r = &requests[o->under_way = next_request++ % many];
    o->sent = now();
    send(o->fd, r->data, r->size, 0);
}

static void walk(struct other *o) {
    unsigned char reply[4096];
    uint32_t id, status;
    size_t count = 0;
    int version;
    struct request *r = &requests[o->under_way];
    ssize_t n = recv(o->fd, reply, sizeof reply, MSG_DONTWAIT);
    if (n < 0)
        return;
    if (look(reply, n, &version, &id, &status, &count) || version != r->version || id != r->id || status) {
        not_walked++;
        return;
    }
    walked++;
    varbinds += count;
    walk_on(o);
}

static void scrape_anew(struct other *o, int poll) {
    struct epoll_event e = {.events = EPOLLIN, .data.ptr = o};
    o->fd = socket(AF_INET, SOCK_STREAM, 0);
    if (connect(o->fd, (struct sockaddr *)&http_address, sizeof http_address) ||
        send(o->fd, scrape_request, strlen(scrape_request), MSG_NOSIGNAL) < 0) {
        perror("scrape");
        exit(1);
    }
    epoll_ctl(poll, EPOLL_CTL_ADD, o->fd, &e);
}

static void scrape(struct other *o, int poll) {
    static char in[1 << 16];
    ssize_t n = recv(o->fd, in, sizeof in, MSG_DONTWAIT);
    if (n > 0)
        scraped += n;
    if (n > 0 || (n < 0 && errno == EAGAIN))
        return;
    scrapes++;
    close(o->fd);
    scrape_anew(o, poll);
}

static unsigned percentile(double share) {
    unsigned long seen = 0;
    for (unsigned us = 0; us < BUCKETS; us++)
        if ((seen += latency_us[us]) > share * replies)
            return us;
    return 0;
}

int main(int argc, char **argv) {
    if (argc != 6 && argc != 9 && argc != 11) {
        fprintf(stderr, "usage: %s PORT CONNECTIONS DEPTH SECONDS UNITS [WALKERS SNMP_PORT FILE [HTTP_PORT ENCODING]]\n",
                argv[0]);
        return 2;
    }
    int port = atoi(argv[1]), connections = atoi(argv[2]), depth = atoi(argv[3]), units = atoi(argv[5]);
    double seconds = atof(argv[4]);
    if (depth < 1 || depth > MAX_DEPTH)
        return 2;
    for (int i = 0; i < REGISTERS; i++)
        expected[2 * i + 1] = i;

    struct peer *peers = calloc(connections, sizeof *peers);
    int poll = epoll_create1(0);
    for (int i = 0; i < connections; i++) {
        struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons(port)};
        to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        int one = 1;
        peers[i].fd = socket(AF_INET, SOCK_STREAM, 0);
        peers[i].unit = 1 + i % units;
        if (connect(peers[i].fd, (struct sockaddr *)&to, sizeof to)) {
            perror("connect");
            return 1;
        }
        setsockopt(peers[i].fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
        struct epoll_event e = {.events = EPOLLIN, .data.ptr = &peers[i]};
        epoll_ctl(poll, EPOLL_CTL_ADD, peers[i].fd, &e);
    }
    int walkers = argc > 6 ? atoi(argv[6]) : 0;
    struct other *others = calloc(walkers + 1, sizeof *others);
    if (walkers) {
        load(argv[8]);
        snmp_address = (struct sockaddr_in){.sin_family = AF_INET, .sin_port = htons(atoi(argv[7]))};
        snmp_address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    }
    for (int i = 0; i < walkers; i++) {
        struct epoll_event e = {.events = EPOLLIN, .data.ptr = &others[i]};
        others[i].what = WALKER;
        others[i].fd = socket(AF_INET, SOCK_DGRAM, 0);
        connect(others[i].fd, (struct sockaddr *)&snmp_address, sizeof snmp_address);
        epoll_ctl(poll, EPOLL_CTL_ADD, others[i].fd, &e);
        walk_on(&others[i]);
    }
    if (argc > 9) {
        http_address = (struct sockaddr_in){.sin_family = AF_INET, .sin_port = htons(atoi(argv[9]))};
        http_address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        snprintf(scrape_request, sizeof scrape_request,
                 "GET /metrics HTTP/1.1\r\nHost: bench\r\nConnection: close\r\nAccept-Encoding: %.20s\r\n\r\n", argv[10]);
        others[walkers].what = SCRAPER;
        scrape_anew(&others[walkers], poll);
    }
    unsigned long closed = 0, asked = (unsigned long)connections * depth;
    double start = now(), end = start + seconds, last = start;
    for (int i = 0; i < connections; i++)
        ask(&peers[i], depth);
    while (replies < asked && now() < end + 1.0) { /* a reply that is a second late is lost */
        struct epoll_event events[256];
        int n = epoll_wait(poll, events, 256, 100);
        for (int i = 0; i < walkers; i++)
            if (now() - others[i].sent > 1.0) {
                not_walked++;
                walk_on(&others[i]);
            }
        for (int i = 0; i < n; i++) {
            struct peer *p = events[i].data.ptr;
            if (p->what == WALKER) {
                walk(events[i].data.ptr);
                continue;
            }
            if (p->what == SCRAPER) {
                scrape(events[i].data.ptr, poll);
                continue;
            }
            int count = take(p);
            if (count < 0) {
                closed++;
                epoll_ctl(poll, EPOLL_CTL_DEL, p->fd, NULL);
                continue;
            }
            if (count > 0) {
                last = now();
                if (last < end) {
                    ask(p, count);
                    asked += count;
                }
            }
        }
    }
    printf("{\"replies\": %lu, \"seconds\": %.6f, \"p50_us\": %u, \"p99_us\": %u, \"wrong\": %lu, \"lost\": %lu, "
           "\"closed\": %lu, \"p999_us\": %u, \"walked\": %zu, \"varbinds\": %zu, \"not_walked\": %zu, \"scrapes\": %zu, "
           "\"scraped\": %zu}\n",
           replies, last - start, percentile(0.50), percentile(0.99), wrong, asked - replies, closed, percentile(0.999),
           walked, varbinds, not_walked, scrapes, scraped);
    return 0;
}
