"""Print which libraries here are others than a lock file says: `python -m tests.supply.versions LOCK`."""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from tests.supply.locked import locked

MADE_WITH = {"pip", "setuptools", "wheel"}
"""What an environment has from the start, in versions of its own."""


def main() -> None:
    """One line for each that differs."""
    differing = []
    for name, pinned in locked(Path(sys.argv[1])).items():
        if name in MADE_WITH:
            continue
        try:
            here = version(name)
        except PackageNotFoundError:
            continue
        if here != pinned:
            differing.append(f"  {name} {pinned} → {here}")
    sys.stdout.write("\n".join(differing or ["  the locked versions are the newest ones"]) + "\n")


if __name__ == "__main__":
    main()
