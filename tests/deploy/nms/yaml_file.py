"""YAML files read by Debian's own PyYAML, so that what is delivered is YAML to others than to us."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

_READ = "import json, sys, yaml; json.dump(yaml.safe_load(sys.stdin.buffer), sys.stdout)"
_PYTHON = "/usr/bin/python3"


def loaded(path: Path) -> Any:
    """The document of a file; skips where there is no PyYAML, fails when CI is set."""
    if subprocess.run([_PYTHON, "-c", "import yaml"], capture_output=True, check=False).returncode:
        reason = "Debian's python3-yaml is not installed; tests/peers/install.sh installs every peer"
        if os.environ.get("CI"):
            pytest.fail(f"{reason} (a missing peer is a failure because CI is set)")
        pytest.skip(reason)
    with path.open("rb") as file:
        return json.loads(subprocess.run([_PYTHON, "-c", _READ], stdin=file, capture_output=True, check=True).stdout)
