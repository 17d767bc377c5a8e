"""What is delivered beside rules and dashboards: it is what its readers accept, and names files that exist."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest


def keys(text: str) -> list[tuple[int, str, str]]:
    """Indent, key and value of each mapping line of a YAML text in block style; AssertionError on anything else."""
    found = []
    for line in text.splitlines():
        bare = re.sub(r"(^|\s)#.*", "", line).rstrip()
        if not bare:
            continue
        assert "\t" not in bare
        match = re.fullmatch(r"(?P<indent> *)(?P<item>- )?(?:(?P<key>[\w-]+):(?: (?P<value>.+))?|(?P<text>.+))", bare)
        assert match is not None, line
        assert len(match["indent"]) % 2 == 0, line
        assert match["key"] or match["item"], line
        found.append(
            (len(match["indent"]) + 2 * bool(match["item"]), match["key"] or "", match["value"] or match["text"] or "")
        )
    return found


def mounts(text: str) -> list[tuple[str, str]]:
    """Host path and path in the container of each file that a service mounts."""
    return re.findall(r"^ +- (\.\S+?):(/\S+):ro$", text, re.MULTILINE)


def test_compose_has_the_shape_and_the_files(delivered: Path) -> None:
    text = (delivered / "compose.yaml").read_text(encoding="utf-8")
    top = [key for indent, key, _ in keys(text) if indent == 0]
    assert top == ["services", "volumes"]
    services = re.split(r"^  (?=\w)", text.partition("services:")[2].partition("\nvolumes:")[0], flags=re.MULTILINE)[1:]
    assert [service.split(":")[0] for service in services] == ["prometheus", "grafana"]
    for service in services:
        known = {key for indent, key, _ in keys(service) if indent == 4 and key}
        assert {"image", "network_mode", "volumes"} <= known
        image = r"image: docker\.io/[\w./-]+:v?\d+\.\d+\.\d+$"
        assert re.search(image, service, re.MULTILINE), "a fixed version, by a name that podman takes too"
    assert len(mounts(text)) == 4
    for host, _ in mounts(text):
        assert (delivered / host).exists(), host
    named = re.findall(r"^ +- ([a-z-]+):/", text, re.MULTILINE)
    assert set(named) == {key for indent, key, _ in keys(text.partition("\nvolumes:")[2]) if indent == 2}
    assert text.count("127.0.0.1") >= 2, "nothing listens for other machines"


def test_what_grafana_reads_lies_where_it_is_mounted(delivered: Path) -> None:
    inside = dict(mounts((delivered / "compose.yaml").read_text(encoding="utf-8")))
    provider = (delivered / "grafana" / "provisioning" / "dashboards" / "prostar.yml").read_text(encoding="utf-8")
    [path] = [value for _, key, value in keys(provider) if key == "path"]
    assert inside["./grafana/dashboards"] == path
    assert inside["./grafana/provisioning"] == "/etc/grafana/provisioning"
    source = (delivered / "grafana" / "provisioning" / "datasources" / "prometheus.yml").read_text(encoding="utf-8")
    [url] = [value for _, key, value in keys(source) if key == "url"]
    assert f"--web.listen-address={url.removeprefix('http://')}" in (delivered / "compose.yaml").read_text(
        encoding="utf-8"
    )


@pytest.mark.peer
@pytest.mark.parametrize("secured", [False, True], ids=["open", "with token and TLS"])
def test_promtool_accepts_the_scrape_configuration(
    peer: Callable[[str], str], delivered: Path, tmp_path: Path, secured: bool
) -> None:
    config = delivered / "prometheus" / "prometheus.yml"
    if secured:  # as its comments say
        text = config.read_text(encoding="utf-8").replace("rules/*.yml", f"{config.parent}/rules/*.yml")
        text = re.sub(r"# (authorization|tls_config)", r"\1", text).replace("/etc/prometheus/", f"{tmp_path}/")
        config = tmp_path / "prometheus.yml"
        config.write_text(text, encoding="utf-8")
        for name in ("prostar-token", "prostar-ca.pem"):
            (tmp_path / name).write_text("x", encoding="utf-8")
    done = subprocess.run(
        [peer("promtool"), "check", "config", str(config)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 rule files found" in done.stdout


def test_the_commands_of_the_readme_name_files_that_exist(delivered: Path) -> None:
    text = (delivered / "README.md").read_text(encoding="utf-8")
    commands = [line for block in re.findall(r"```\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
    assert [command.split()[0] for command in commands] == ["make", "docker", "prometheus"]
    named = re.findall(r"deploy/\S+", "\n".join(commands))
    assert len(named) == 2
    assert all((delivered.parent / path).is_file() for path in named)
    assert re.search(r"^demo:", (delivered.parent / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    rows = re.findall(r"^\| `(.+?)` \|", text, re.MULTILINE)
    assert all((delivered / row).exists() for row in rows)


@pytest.mark.peer
def test_prometheus_takes_the_arguments_of_the_readme(peer: Callable[[str], str], delivered: Path) -> None:
    text = (delivered / "README.md").read_text(encoding="utf-8")
    [command] = re.findall(r"^prometheus (.*)$", text, re.MULTILINE)
    known = subprocess.run([peer("prometheus"), "--help"], capture_output=True, text=True, check=True)
    offered = known.stdout + known.stderr
    for argument in command.split():
        assert argument.partition("=")[0] in offered
