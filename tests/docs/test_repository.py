"""What the files at the top of the repository promise."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LOCKS = ("requirements.txt", "requirements-dev.txt")
ALL_LOCKS = (*LOCKS, "requirements-audit.txt")
PAGES = sorted(page.relative_to(ROOT) for page in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")))


def read(name: str | Path) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def locked(name: str) -> dict[str, str]:
    """Package → version of a lock file."""
    return {normal(found[1]): found[2] for found in re.finditer(r"^([\w.-]+)==(\S+)", read(name), re.MULTILINE)}


def wanted(*extras: str) -> set[str]:
    """The packages that pyproject.toml asks for."""
    project = tomllib.loads(read("pyproject.toml"))
    asked = [*project["project"]["dependencies"], *project["build-system"]["requires"]]
    for extra in extras:
        asked += project["project"]["optional-dependencies"][extra]
    return {normal(re.split(r"[\s\[<>=!~;]", requirement, maxsplit=1)[0]) for requirement in asked}


@pytest.mark.parametrize("name", ALL_LOCKS)
def test_a_lock_names_no_index_and_no_host(name: str) -> None:
    assert not re.search(r"https?://|file://|--(extra-)?index-url|--find-links|--trusted-host", read(name))


@pytest.mark.parametrize("name", ALL_LOCKS)
def test_every_locked_package_has_a_hash(name: str) -> None:
    for entry in re.split(r"\n(?=\S)", read(name)):
        if "==" in entry.partition("\n")[0]:
            assert "--hash=sha256:" in entry, entry.partition("\n")[0]


@pytest.mark.parametrize(
    ("name", "extras"), [("requirements.txt", ["fast"]), ("requirements-dev.txt", ["fast", "dev"])]
)
def test_the_lock_covers_what_the_project_asks_for(name: str, extras: list[str]) -> None:
    assert wanted(*extras) - set(locked(name)) == set()


def test_users_run_what_is_tested() -> None:
    runtime, dev = map(locked, LOCKS)
    assert {name: (version, dev.get(name)) for name, version in runtime.items() if dev.get(name) != version} == {}


def test_ci_runs_the_test_command_of_the_readme() -> None:
    assert re.search(r"^\s*make test\b", read(".ci/run"), re.MULTILINE)
    assert "`make test`" in read("README.md") or re.search(r"^make test\b", read("README.md"), re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_make_targets_that_are_named_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", read("Makefile"), re.MULTILINE))
    named = set(re.findall(r"(?:^|`)make ([a-z-]+)", read(page), re.MULTILINE))
    assert named - targets == set()


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_relative_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", read(page))
    broken = [link for link in links if ":" not in link and not (ROOT / page.parent / link).exists()]
    assert broken == []


def test_every_target_of_the_makefile_is_explained() -> None:
    makefile = read("Makefile")
    phony = set(re.findall(r"^\.PHONY: (.+)$", makefile, re.MULTILINE))
    explained = set(re.findall(r"^([a-z-]+):.*## \S", makefile, re.MULTILINE))
    assert phony == explained


def test_make_help_is_two_columns() -> None:
    done = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True)
    explained = [line.index(re.split(r" make \S+ +", line)[1]) for line in done.stdout.splitlines()]
    assert set(explained) == {19}


def named_tests() -> list[tuple[str, str]]:
    """Page and `tests/…py::test_…` of every promise that names its proof."""
    pattern = re.compile(r"`(tests/[\w/.]+\.py(?:::\w+)?)`")
    return [(str(page), name) for page in PAGES for name in pattern.findall(read(page))]


@pytest.mark.parametrize(("page", "name"), named_tests())
def test_a_promise_names_a_test_that_exists(page: str, name: str) -> None:
    path, _, function = name.partition("::")
    assert (ROOT / path).is_file(), page
    assert not function or re.search(rf"^(?:async )?def {function}\(", read(path), re.MULTILINE), page


def test_the_readme_opens_with_the_problem_and_the_two_commands() -> None:
    opening = read("README.md").splitlines()[:12]
    problem = [line for line in opening[2:] if line][:5]
    assert all(len(line) <= 140 for line in problem)
    assert opening[8] == "```"
    assert [line.split("#")[0].strip() for line in opening[9:11]] == ["make demo", "make test"]


def test_the_readme_shows_a_configuration_that_is_right(tmp_path: Path) -> None:
    from gateway.service.config import load_config

    (example,) = re.findall(r"```toml\n(.*?)```", read("README.md"), re.DOTALL)
    path = tmp_path / "readme.toml"
    path.write_text(example, encoding="utf-8")
    assert load_config(path).site == "ridge-07"
