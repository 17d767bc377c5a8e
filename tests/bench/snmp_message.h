/* Ready SNMP requests in a file, and what has to be known of a message to count a reply as right.
 *
 * The file holds requests, each behind its length in two octets.
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

struct request { const uint8_t *data; int size; uint32_t id; int version; };

static struct request *requests;
static size_t many;

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
