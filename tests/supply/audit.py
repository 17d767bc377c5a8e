"""`make audit`: licences and SBOM of the locked libraries into a folder, and what is known to be wrong with them.

    python -m tests.supply.audit --tools FOLDER_OF_PIP_AUDIT_AND_CYCLONEDX --output dist

Exit 0: nothing is known against them. 1: there are holes, or a licence is not one of ALLOWED. 3: the advisory service
could not be asked about all of them; nothing is known either way then. pip-audit alone would call that a success.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import Distribution, distribution
from pathlib import Path

from tests.supply.locked import locked

LOCK = Path("requirements.txt")
ALLOWED = {
    "0BSD",
    "Apache-2.0",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "CNRI-Python",
    "ISC",
    "MIT",
    "MIT-0",
    "PSF-2.0",
    "Unlicense",
}
"""Licences that let a site run and change the gateway as its own licence does."""

_BY_NAME = (
    (r"apache.*2(\.0)?|apache software", "Apache-2.0"),
    (r"mit( license)?\b", "MIT"),
    (r"bsd.*2|2-clause|simplified", "BSD-2-Clause"),
    (r"bsd", "BSD-3-Clause"),
    (r"isc", "ISC"),
    (r"python software foundation|psf", "PSF-2.0"),
)
"""How metadata of before PEP 639 calls them; the first that fits."""

_BY_TEXT = (
    (r"Redistributions of source code.*Neither the name", "BSD-3-Clause"),
    (r"Redistributions of source code", "BSD-2-Clause"),
    (r"Permission is hereby granted, free of charge", "MIT"),
)
"""What their texts say, where the metadata name nothing but the file."""


@dataclass(frozen=True, slots=True)
class Package:
    """One locked library with its licence as an SPDX expression, "" where its metadata do not tell."""

    name: str
    version: str
    licence: str

    @property
    def allowed(self) -> bool:
        """Whether every part of the expression may be used; of alternatives one is enough."""
        alternatives = re.split(r"\s+OR\s+", self.licence.replace("(", "").replace(")", ""))
        return any(
            all(part.strip() in ALLOWED for part in re.split(r"\s+AND\s+", each)) for each in alternatives if each
        )


def licence_of(found: Distribution) -> str:
    """The SPDX expression of a distribution."""
    metadata = found.metadata.json
    if "license_expression" in metadata:
        return str(metadata["license_expression"])
    classifiers = [each for each in metadata.get("classifier", ()) if each.startswith("License ::")]
    names = [each.rpartition(" :: ")[2] for each in classifiers if each.count("::") > 1]
    for told in (*names, str(metadata.get("license", "")).partition("\n")[0]):
        for pattern, spdx in _BY_NAME:
            if re.search(pattern, told, re.IGNORECASE):
                return spdx
    for file in found.files or ():
        if not re.search(r"\.dist-info/.*LICEN[CS]E", str(file)):
            continue
        text = file.read_text(encoding="utf-8")
        for pattern, spdx in _BY_TEXT:
            if re.search(pattern, text, re.DOTALL):
                return spdx
    return ""


def packages(lock: Path) -> list[Package]:
    """The libraries of a lock file, as they are installed here."""
    found = []
    for name, version in sorted(locked(lock).items()):
        installed = distribution(name)
        if installed.version != version:
            raise SystemExit(f"{name} {installed.version} is installed, but {version} is locked: make setup")
        found.append(Package(name, version, licence_of(installed)))
    return found


def table(found: list[Package]) -> str:
    """The licence list for people."""
    rows = "\n".join(f"| {each.name} | {each.version} | {each.licence or '**unknown**'} |" for each in found)
    return f"# Licences of the libraries\n\n| library | version | licence |\n|---|---|---|\n{rows}\n"


def judge(report: str) -> tuple[int, str]:
    """Exit status and what to say about pip-audit's JSON."""
    try:
        entries = json.loads(report)["dependencies"]
    except (ValueError, KeyError, TypeError):
        return (
            3,
            "the advisory service could not be asked; nothing is known either way. Try again where it can be reached",
        )
    asked = [entry for entry in entries if "skip_reason" not in entry]
    holes = [
        f"  {entry['name']} {entry['version']}: {hole['id']}, mended in {', '.join(hole['fix_versions']) or 'none'}"
        for entry in asked
        for hole in entry["vulns"]
    ]
    if holes:
        return 1, "\n".join((f"{len(holes)} known holes:", *holes))
    if not entries or len(asked) < len(entries):
        few = f"the advisory service could be asked about {len(asked)} of {len(entries)} libraries only"
        return 3, f"{few}; of the others nothing is known either way. Try again where it can be reached"
    return 0, f"no known hole in {len(asked)} libraries"


def main() -> None:
    """Write and ask."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--tools", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    options.output.mkdir(exist_ok=True)
    found = packages(LOCK)
    (options.output / "licences.md").write_text(table(found), encoding="utf-8")
    wrong = [each for each in found if not each.allowed]
    say(f"{options.output}/licences.md: {len(found)} libraries, {len(wrong)} with a licence to look at")
    for each in wrong:
        say(f"  {each.name} {each.version}: {each.licence or 'unknown'}")
    sbom = options.output / "sbom.json"
    command = [options.tools / "cyclonedx-py", "requirements", LOCK, "--pyproject", "pyproject.toml", "--of", "JSON"]
    subprocess.run([*command, "--output-file", sbom], check=True, stderr=subprocess.DEVNULL)
    say(f"{sbom}: {len(json.loads(sbom.read_text(encoding='utf-8'))['components'])} components")
    ask = [options.tools / "pip-audit", "--requirement", LOCK, "--require-hashes", "--disable-pip", "--format", "json"]
    done = subprocess.run([*ask, "--progress-spinner", "off"], capture_output=True, text=True, check=False)
    status, text = judge(done.stdout)
    say(text)
    raise SystemExit(status or int(bool(wrong)))


def say(text: str) -> None:
    """To standard output."""
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
