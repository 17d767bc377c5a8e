/* libmodbus as a user would put it up: one process, poll(), every unit answers from one table.
 *
 *   libmodbus_server PORT      register i holds i
 */
#include <errno.h>
#include <modbus.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <unistd.h>

enum { MOST = 1024 };

int main(int argc, char **argv) {
    if (argc != 2)
        return 2;
    modbus_t *context = modbus_new_tcp("127.0.0.1", atoi(argv[1]));
    modbus_mapping_t *table = modbus_mapping_new(0, 0, 128, 0);
    for (int i = 0; i < 128; i++)
        table->tab_registers[i] = i;
    int listening = modbus_tcp_listen(context, 128);
    if (listening < 0) {
        perror("listen");
        return 1;
    }
    struct pollfd sockets[MOST] = {{.fd = listening, .events = POLLIN}};
    int count = 1;
    while (poll(sockets, count, -1) >= 0 || errno == EINTR) {
        for (int i = count - 1; i > 0; i--) {
            if (!sockets[i].revents)
                continue;
            unsigned char request[MODBUS_TCP_MAX_ADU_LENGTH];
            modbus_set_socket(context, sockets[i].fd);
            int size = modbus_receive(context, request);
            if (size < 0) {
                close(sockets[i].fd);
                sockets[i] = sockets[--count];
            } else if (size > 0) {
                modbus_reply(context, request, size, table);
            }
        }
        if (sockets[0].revents && count < MOST) {
            int fd = modbus_tcp_accept(context, &listening);
            if (fd >= 0)
                sockets[count++] = (struct pollfd){.fd = fd, .events = POLLIN};
        }
    }
    return 0;
}
