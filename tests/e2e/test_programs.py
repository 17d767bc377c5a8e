"""What the end-to-end tests share is right itself."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.e2e.programs import REPOSITORY, wait_until

KILLED = """
import os, signal, sys
from tests.e2e.programs import Program

print(Program(["sleep", "600"]).process.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_nothing_is_left_of_tests_that_are_killed() -> None:
    variables = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run([sys.executable, "-c", KILLED], stdout=subprocess.PIPE, check=False, env=variables)
    status = Path(f"/proc/{int(done.stdout)}/stat")

    def ended() -> bool:
        try:
            return status.read_text().rpartition(")")[2].split()[0] in "ZX"  # who ends it may be slow to take it away
        except (FileNotFoundError, ProcessLookupError):
            return True

    wait_until(ended, "the end of the program")
