"""SNMP reads of 200 devices × 80 columns: the gateway against net-snmp's snmpd with a table in C, one table a question.

    .venv/bin/python -m tests.bench.bench_snmp [--rounds 3] [--seconds 1] [--sockets 8]

The servers run one after the other in every round, on one core (the others are stopped meanwhile), the load generator
(snmp_load.c) on another; ratios are taken within a round and their median is shown. Requests are made here before a
run, so the generator only sends them: GET of every cell, GETNEXT of every cell, GETBULK from every 50th cell, which
together is a walk. SNMPv3 is authPriv with SHA-256 and AES-128. One reply a run is read and checked whole here.

Then the longest CPU time for which the SNMP face held the event loop, while its whole tree (every table, not only
the 80 columns) is walked by GETBULK-50 from one OID to the next, the first time and again; and Modbus TCP's latency,
alone and while the 80 columns are walked and /metrics is scraped without a pause, all by one load generator
(modbus_load.c).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Self

from gateway.faces.snmp import reader, v3, wire
from gateway.faces.snmp.layout import shipped_layout
from gateway.faces.snmp.objects import RowKind
from gateway.faces.snmp.settings import Oid
from gateway.faces.snmp.usm import LocalUser
from tests.bench.bench_modbus_tcp import HERE, compiled, cpu_s, free_port, say, where
from tests.bench.snmp_server import BENCH, MODEL, UNITS

COLUMNS = 80
WALKERS = 8
BESIDE = "beside"
REPETITIONS = 50
START_S = 15.0
REFERENCE = "snmpd"
CONFIGURATION = """
agentAddress udp:127.0.0.1:{port}
rocommunity public 127.0.0.1
dontLogTCPWrappersConnects yes
rouser bench authpriv
dlmod snmp_table {table}
"""
SECRET_CONFIGURATION = "createUser bench SHA-256 authpass123 AES privpass123\n"


@dataclass(frozen=True)
class Question:
    """What is asked, over which version."""

    name: str
    version: int
    kind: int

    def pdu(self, number: int, name: bytes) -> bytes:
        """One request."""
        counts = (0, REPETITIONS) if self.kind == reader.GET_BULK else (0, 0)
        head = wire.integer(0x02, number) + wire.integer(0x02, counts[0]) + wire.integer(0x02, counts[1])
        return wire.tlv(self.kind, head + wire.tlv(0x30, wire.varbind(name, b"\x05\x00")))


QUESTIONS = (
    Question("v2c GET", 1, reader.GET),
    Question("v2c GETNEXT", 1, reader.GET_NEXT),
    Question(f"v2c GETBULK-{REPETITIONS}", 1, reader.GET_BULK),
    Question("v3 GET", 3, reader.GET),
    Question(f"v3 GETBULK-{REPETITIONS}", 3, reader.GET_BULK),
)


@dataclass(frozen=True)
class Server:
    """A running agent and the cells it has."""

    name: str
    process: subprocess.Popen[bytes]
    port: int
    modbus_port: int
    http_port: int
    cells: tuple[Oid, ...]


@dataclass(frozen=True)
class Run:
    """What one server did in one round."""

    rate: float
    cells: float  # varbinds a second
    cpu_us: float
    p50_us: int
    p99_us: int
    lost: int
    wrong: int


class Asker:
    """A poller: exchanges one datagram, and signs in as SNMPv3 asks for it."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.settimeout(1)
        self.user: LocalUser | None = None
        self._sealers: dict[LocalUser | None, v3.Sealer] = {}
        self.authority = v3.Authority(b"", 0, 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def exchange(self, data: bytes) -> bytes:
        """The reply to a datagram; TimeoutError without one."""
        self._socket.send(data)
        return self._socket.recv(4096)

    def sign_in(self) -> None:
        """Learn engine id, boots and time: RFC 3414 §4."""
        pdu = wire.tlv(reader.GET, wire.integer(0x02, 0) * 3 + wire.tlv(0x30, b""))
        found = self._message(self.exchange(self.sealed(None, v3.REPORTABLE, pdu)))
        self.user = LocalUser(BENCH, found.engine_id)
        self.authority = v3.Authority(found.engine_id, 0, 0)
        found = self._message(self.exchange(self.sealed(self.user, 7, pdu)))  # notInTimeWindow tells the time
        self.authority = v3.Authority(found.engine_id, found.boots, found.time)

    def sealed(self, user: LocalUser | None, flags: int, pdu: bytes, number: int = 1) -> bytes:
        """An SNMPv3 message around a PDU."""
        scoped = v3.scoped(self.authority.engine_id, b"", pdu)
        return self._sealer(user).seal(self.authority, wire.integer(0x02, number), flags, scoped)

    def _sealer(self, user: LocalUser | None) -> v3.Sealer:
        return self._sealers.setdefault(user, v3.Sealer(user))

    def request(self, question: Question, number: int, name: bytes) -> bytes:
        """A whole request message."""
        pdu = question.pdu(number, name)
        if question.version == reader.VERSION_3:
            return self.sealed(self.user, 7, pdu, number)
        return wire.tlv(0x30, wire.integer(0x02, question.version) + wire.tlv(0x04, b"public") + pdu)

    def varbinds(self, reply: bytes) -> list[bytes]:
        """The contents of the varbinds of an authentic and errorless reply."""
        version, _, at = reader.version(reply)
        if version == reader.VERSION_3:
            message = self._message(reply)
            assert self.user is not None
            size = self.user.mac.size
            blank = reply[: message.mac_at] + bytes(size) + reply[message.mac_at + size :]
            assert self.user.mac.of(blank) == message.mac
            first, end = reader.content(reply, message.body_at, len(reply), 0x04)
            vector = v3.vector(message.boots, message.time, message.salt)
            reply = self.user.cfb.decrypt(vector, reply[first:end])
            at = v3.scope(reply, 0).pdu_at
        else:
            at = reader.community(reply, at)[1]
        end = len(reply)
        at, _ = reader.content(reply, at, end, wire.RESPONSE)
        _, at = reader.integer(reply, at, end)
        status, at = reader.integer(reply, at, end)
        _, at = reader.integer(reply, at, end)
        at, _ = reader.content(reply, at, end, 0x30)
        assert status == 0, f"error-status {status}"
        found = []
        while at < end:
            first, at = reader.content(reply, at, end, 0x30)
            found.append(reply[first:at])
        return found

    @staticmethod
    def _message(data: bytes) -> v3.Message:
        return v3.parse(data, reader.version(data)[2])


def gateway_cells() -> tuple[Oid, ...]:
    """The first 80 columns of points that the devices have, 200 rows, in order."""
    columns = [
        (*table.base, 1, column.number)
        for table in shipped_layout().tables
        for column in table.columns
        if table.rows is RowKind.DEVICE and column.point is not None and column.models and MODEL in column.models
    ]
    return tuple((*column, unit) for column in sorted(columns)[:COLUMNS] for unit in range(1, UNITS + 1))


def snmpd_cells() -> tuple[Oid, ...]:
    """The table of snmp_table.c."""
    return tuple(
        (1, 3, 6, 1, 4, 1, 32473, 99, 1, 1, column, row)
        for column in range(1, COLUMNS + 1)
        for row in range(1, UNITS + 1)
    )


def started(name: str, folder: Path, core: int) -> Server:
    """Start one server on a core; returns when it answers."""
    port, modbus_port, http_port = free_port(), free_port(), free_port()
    environment = dict(os.environ)
    if name == REFERENCE:
        table = folder / "snmp_table.so"
        flags = subprocess.run(["net-snmp-config", "--base-cflags"], check=True, capture_output=True, text=True)
        build = ["gcc", "-O2", "-Wall", "-fPIC", "-shared", "-o", str(table), str(HERE / "snmp_table.c")]
        subprocess.run([*build, *flags.stdout.split()], check=True)
        configuration = folder / "snmpd.conf"
        configuration.write_text(CONFIGURATION.format(port=port, table=table) + SECRET_CONFIGURATION)
        environment.update(SNMP_PERSISTENT_DIR=str(folder), SNMPCONFPATH=str(folder), MIBS="")
        command = ["/usr/sbin/snmpd", "-f", "-Lf", "/dev/null", "-C", "-c", str(configuration)]
        cells = snmpd_cells()
    else:
        loop = name.rpartition(" ")[2]
        command = [sys.executable, "-m", "tests.bench.snmp_server", str(port), str(modbus_port), str(http_port), loop]
        cells = gateway_cells()
    process = subprocess.Popen(
        ["taskset", "-c", str(core), *command], env=environment, cwd=HERE.parents[1], stdout=subprocess.PIPE
    )
    server = Server(name, process, port, modbus_port, http_port, cells)
    until = time.monotonic() + START_S
    with Asker(port) as asker:
        while True:
            try:
                asker.exchange(asker.request(QUESTIONS[0], 1, wire.object_identifier(cells[0])))
            except OSError:
                if process.poll() is not None or time.monotonic() > until:
                    process.kill()
                    raise
                time.sleep(0.1)
            else:
                return server


@contextlib.contextmanager
def awake(server: Server) -> Iterator[None]:
    """Let a stopped server run."""
    os.kill(server.process.pid, signal.SIGCONT)
    try:
        yield
    finally:
        os.kill(server.process.pid, signal.SIGSTOP)


def requests(question: Question, server: Server, path: Path) -> None:
    """Write the requests of a whole walk to `path`, and check one reply."""
    step = REPETITIONS if question.kind == reader.GET_BULK else 1
    with Asker(server.port) as asker:
        if question.version == reader.VERSION_3:
            asker.sign_in()
        names = [wire.object_identifier(cell) for cell in server.cells[::step]]
        made = [asker.request(question, number, name) for number, name in enumerate(names, 0x01010101)]
        found = len(asker.varbinds(asker.exchange(made[len(made) // 2])))
    assert found == (1 if step == 1 else found) and found >= step * 0.6, f"{found} varbinds"  # noqa: PT018
    path.write_bytes(b"".join(len(each).to_bytes(2) + each for each in made))


def measure(generator: Sequence[str], question: Question, server: Server, path: Path) -> Run:
    """One run of the load generator; requests that are at `path` already are sent again, if time allows it."""
    if question.version == reader.VERSION_3 or not path.exists():
        requests(question, server, path)
    sockets, seconds = generator[-2:]
    command = [*generator[:-2], str(server.port), sockets]
    subprocess.run([*command, "0.2", str(path)], check=True, stdout=subprocess.DEVNULL)  # warm up
    before = cpu_s(server.process.pid)
    done = subprocess.run([*command, seconds, str(path)], check=True, capture_output=True, text=True)
    used = cpu_s(server.process.pid) - before
    result = json.loads(done.stdout)
    replies = max(1, result["replies"])
    return Run(
        rate=result["replies"] / result["seconds"],
        cells=result["varbinds"] / result["seconds"],
        cpu_us=used / replies * 1e6,
        p50_us=result["p50_us"],
        p99_us=result["p99_us"],
        lost=result["lost"],
        wrong=result["wrong"],
    )


def table(runs: dict[str, list[Run]]) -> str:
    """Medians over the rounds; ratios are medians of the ratios within a round."""
    reference = runs.get(REFERENCE)
    head = ["server", "replies/s", f"× {REFERENCE}", "CPU µs a reply", f"÷ {REFERENCE}", "p50 µs", "p99 µs"]
    head += ["lost", "wrong"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name, own in runs.items():
        # A server may have used less CPU in a short round than the kernel counts: that round has no ratio.
        pairs = [(a, b) for a, b in zip(own, reference or (), strict=bool(reference)) if b.rate and b.cpu_us]
        cells = [
            name,
            f"{statistics.median(run.rate for run in own):,.0f}",
            f"{statistics.median(a.rate / b.rate for a, b in pairs):.2f}" if pairs else "–",
            f"{statistics.median(run.cpu_us for run in own):.1f}",
            f"{statistics.median(a.cpu_us / b.cpu_us for a, b in pairs):.2f}" if pairs else "–",
            f"{statistics.median(run.p50_us for run in own):,.0f}",
            f"{statistics.median(run.p99_us for run in own):,.0f}",
            str(sum(run.lost for run in own)),
            str(sum(run.wrong for run in own)),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def longest_turn_ms(server: Server) -> float:
    """The longest turn since this was last asked."""
    assert server.process.stdout is not None
    server.process.send_signal(signal.SIGUSR1)
    return float(server.process.stdout.readline())


def whole_walk(server: Server, question: Question) -> str:
    """Walk everything there is, and tell how long the loop was held."""
    longest_turn_ms(server)
    name, cells, replies = wire.object_identifier((1, 3)), 0, 0
    before = cpu_s(server.process.pid)
    with Asker(server.port) as asker:
        if question.version == reader.VERSION_3:
            asker.sign_in()
        while True:
            found = asker.varbinds(asker.exchange(asker.request(question, replies + 1, name)))
            replies += 1
            if found[-1].endswith(wire.END_OF_MIB_VIEW):
                break
            cells += len(found)
            name = found[-1][: 2 + found[-1][1]]
    used = cpu_s(server.process.pid) - before
    return f"| {question.name} | {cells:,} | {replies:,} | {used:.2f} | {longest_turn_ms(server):.2f} |"


def beside_modbus(server: Server, folder: Path, rounds: int, seconds: float, core: int) -> str:
    """Modbus TCP latency of a server, alone and while others ask who never pause: 16 clients, one request each."""
    walk = folder / "walk"
    requests(QUESTIONS[2], server, walk)
    modbus = ["taskset", "-c", str(core), compiled("modbus_load.c", folder), str(server.modbus_port)]
    modbus += ["16", "1", str(seconds), "8"]
    walkers, scraper = [str(server.port), str(walk)], [str(server.http_port), "identity"]
    beside_it = {
        "alone": [],
        "a walk": ["1", *walkers],
        f"{WALKERS} walks": [str(WALKERS), *walkers],
        "scrapes": ["0", *walkers, *scraper],
        "a walk and scrapes": ["1", *walkers, *scraper],
    }
    found: dict[str, list[dict[str, float]]] = {name: [] for name in beside_it}
    for _ in range(rounds):
        for name, others in beside_it.items():
            done = subprocess.run([*modbus, *others], check=True, capture_output=True, text=True)
            found[name].append(json.loads(done.stdout))
    head = ["beside", "replies/s", "p50 µs", "p99 µs", "÷ alone", "lost", "wrong", "cells/s walked", "scrapes/s"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name, results in found.items():
        rates = {
            key: statistics.median(each[key] / each["seconds"] for each in results)
            for key in ("replies", "varbinds", "scrapes")
        }
        p50, p99 = (statistics.median(each[key] for each in results) for key in ("p50_us", "p99_us"))
        ratio = statistics.median(
            each["p99_us"] / alone["p99_us"] for each, alone in zip(results, found["alone"], strict=True)
        )
        lost = sum(each["lost"] + each["not_walked"] for each in results)
        wrong = sum(each["wrong"] for each in results)
        lines.append(
            f"| {name} | {rates['replies']:,.0f} | {p50:,.0f} | {p99:,.0f} | {ratio:.2f} | {lost:.0f} | {wrong:.0f} "
            f"| {rates['varbinds']:,.0f} | {rates['scrapes']:.0f} |"
        )
    return "\n".join(lines)


def beside(server: Server, folder: Path, options: argparse.Namespace, usable: Sequence[int]) -> None:
    """What a walk does to others, printed."""
    with awake(server):
        say(f"\nA walk of the whole tree ({server.name})\n")
        say("| walk | cells | replies | CPU s | longest turn, CPU ms |\n|---|---|---|---|---|")
        for question in (QUESTIONS[2], QUESTIONS[2], QUESTIONS[4]):
            say(whole_walk(server, question))
        say(f"\nModbus TCP beside a walk ({server.name}), 16 clients\n")
        say(beside_modbus(server, folder, options.rounds, options.seconds, usable[-1]))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--sockets", type=int, default=8)
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="QUESTION",
        help=f"ask only what has one of these words in its name; {BESIDE}: what a walk does to others",
    )
    options = parser.parse_args()
    for tool in ("gcc", "taskset"):
        if shutil.which(tool) is None:
            sys.exit(f"this benchmark needs {tool}")
    usable = sorted(os.sched_getaffinity(0))
    names = ["gateway, asyncio"]
    if find_spec("uvloop"):
        names.append("gateway, uvloop")
    if shutil.which("net-snmp-config") and Path("/usr/sbin/snmpd").exists():
        names.append(REFERENCE)
    else:
        say("left out: snmpd (Debian packages snmpd and libsnmp-dev are not installed)")
    with tempfile.TemporaryDirectory(prefix="bench-") as made, contextlib.ExitStack() as ending:
        folder = Path(made)
        compiled("snmp_load.c", folder)
        generator = ["taskset", "-c", str(usable[-1]), str(folder / "snmp_load")]
        servers = []
        for name in names:
            server = started(name, folder, usable[0])
            ending.callback(server.process.wait)
            ending.callback(server.process.kill)
            os.kill(server.process.pid, signal.SIGSTOP)
            servers.append(server)
        command = [*generator, str(options.sockets), str(options.seconds)]
        say(
            f"\n{UNITS} devices × {COLUMNS} columns, {options.sockets} askers, {options.rounds} rounds of"
            f" {options.seconds:g} s a server; {where()}"
        )
        wanted = [each for each in QUESTIONS if not options.only or any(word in each.name for word in options.only)]
        for question in wanted:
            runs: dict[str, list[Run]] = {name: [] for name in names}
            for _ in range(options.rounds):
                for server in servers:
                    with awake(server):
                        runs[server.name].append(
                            measure(command, question, server, folder / f"{question.name} {server.port}")
                        )
            say(f"\n{question.name}\n\n{table(runs)}")
        if not options.only or BESIDE in options.only:
            beside(
                servers[names.index("gateway, uvloop") if "gateway, uvloop" in names else 0], folder, options, usable
            )


if __name__ == "__main__":
    main()
