"""Why an address cannot be listened on."""

from __future__ import annotations

import asyncio
import errno
import socket

import pytest

from gateway.faces.binding import bind_problem, listening_socket


@pytest.mark.parametrize("number", [errno.EADDRINUSE, errno.EACCES, errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT])
def test_a_bind_problem_is_told_in_words(number: int) -> None:
    assert "Errno" not in bind_problem(OSError(number, "x"))
    assert len(bind_problem(OSError(number, "x"))) > 10


def test_another_bind_problem_is_told_as_the_system_does() -> None:
    assert bind_problem(OSError(errno.EMFILE, "Too many open files")) == "Too many open files"


def test_what_an_event_loop_makes_of_it_is_told_without_its_address() -> None:
    told = bind_problem(OSError(errno.EMFILE, "error while attempting to bind on address ('127.0.0.1', 502): too many"))
    assert told == "Too many open files"


async def test_what_comes_in_leaves_little_in_the_kernel() -> None:
    """Who reads no replies would have megabytes there, of the memory that all connections of the machine share."""
    with await listening_socket("127.0.0.1", 0, send_buffer=65536) as listening:
        with socket.create_connection(listening.getsockname()):
            accepted, _ = await asyncio.get_running_loop().sock_accept(listening)
        with accepted:
            assert accepted.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) <= 2 * 65536  # the kernel's own doubling


def test_a_name_that_nobody_knows() -> None:
    error = socket.gaierror(socket.EAI_NONAME, "Name or service not known")
    assert bind_problem(error) == "the name does not resolve to an address"


def test_what_has_no_number_is_told_as_it_is() -> None:
    assert bind_problem(OSError("something else")) == "something else"
