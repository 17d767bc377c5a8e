"""podman for a test: with its images and containers in the test's folder, on a machine that may be a container itself.

Rule 1: what a test runs through `sh` finds this podman by the name `podman`, so that a page's commands run as printed.
Rule 2: crun takes no hybrid of the two versions of control groups, which some machines have. So everything runs in a
        mount namespace where the second one is not to be seen; one for all, for containers outlive a command.
"""

from __future__ import annotations

import os
import resource
import subprocess
from pathlib import Path

import pytest

BASE = "docker.io/library/debian:13-slim"
TRUSTED = Path("/etc/ssl/certs/ca-certificates.crt")
HIDDEN = "mount --make-rprivate / && { umount /sys/fs/cgroup/unified 2>/dev/null; echo; exec sleep infinity; }"
SLIM = ("usr/share/doc", "usr/share/man", "usr/share/locale", "var/lib/apt/lists", "var/cache/apt", "dev")


class Podman:
    """Until `close`."""

    def __init__(self, podman: str, folder: Path) -> None:
        self._folder = folder
        limits = []
        for name, number in (("nofile", resource.RLIMIT_NOFILE), ("nproc", resource.RLIMIT_NPROC)):
            most = min([4096, *(limit for limit in resource.getrlimit(number) if limit >= 0)])
            limits.append(f"{name}={most}:{most}")  # podman asks for more than some machines may give
        (folder / "containers.conf").write_text(
            '[engine]\ncgroup_manager = "cgroupfs"\nevents_logger = "file"\n'
            f'tmp_dir = "{folder}/podman"\nruntime = "crun"\n'
            f'[containers]\nlog_driver = "k8s-file"\ndefault_ulimits = {limits}\n'.replace("'", '"')
        )
        (folder / "storage.conf").write_text(
            f'[storage]\ndriver = "overlay"\ngraphroot = "{folder}/storage"\nrunroot = "{folder}/run"\n'
        )
        keeper = ["setpriv", "--pdeathsig", "KILL", "unshare", "--mount", "sh", "-c", HIDDEN]
        self._keeper = subprocess.Popen(keeper, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert self._keeper.stdout is not None
        if not self._keeper.stdout.readline():
            self._keeper.communicate()
            pytest.skip("mount namespaces are not permitted here")
        (folder / "bin").mkdir()
        program = folder / "bin" / "podman"
        program.write_text(f'#!/bin/sh\nexec nsenter --target {self._keeper.pid} --mount --wdns="$PWD" {podman} "$@"\n')
        program.chmod(0o755)
        self._environment = {
            **os.environ,
            "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ.get('PATH', os.defpath)}",
            "CONTAINERS_CONF": str(folder / "containers.conf"),
            "CONTAINERS_STORAGE_CONF": str(folder / "storage.conf"),
            "TMPDIR": str(folder),
        }

    def sh(self, command: str, cwd: Path, *, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run a shell command; fails with what it said, unless `check` is False."""
        done = subprocess.run(
            ["bash", "-o", "pipefail", "-c", command],
            cwd=cwd,
            env=self._environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=400,
        )
        if check and done.returncode != 0:
            pytest.fail(f"{command}: status {done.returncode}\n{done.stdout[-3000:]}{done.stderr[-3000:]}")
        return done

    def __call__(self, arguments: str) -> str:
        """What `podman ARGUMENTS` prints."""
        return self.sh(f"podman {arguments}", self._folder).stdout.strip()

    def base(self, debootstrap: str) -> None:
        """The image that the Containerfile begins with: the registry's, else one made of Debian's packages; or skip."""
        if self.sh(f"podman pull --quiet {BASE}", self._folder, check=False).returncode != 0:
            root = self._folder / "root"
            made = self.sh(f"{debootstrap} --variant=minbase trixie {root}", self._folder, check=False)
            if made.returncode != 0:
                pytest.skip(f"neither a registry nor debootstrap gives a base image here: {made.stderr[-500:]}")
            away = " ".join(f"--exclude=./{path}/*" for path in SLIM)
            packed = f"tar -C {root} {away} -c . | podman import --change CMD=bash - {BASE}"
            kept = self.sh(packed, self._folder, check=False)
            self.sh(f"rm -rf {root}", self._folder)
            if kept.returncode != 0:
                pytest.skip(f"podman cannot keep images here: {kept.stderr[-500:]}")
        tried = self.sh(f"podman run --rm --network host {BASE} true", self._folder, check=False)
        if tried.returncode != 0:
            pytest.skip(f"containers cannot be run here: {tried.stderr.strip()}")

    def trust(self) -> str:
        """Options of `build` by which pip in it trusts whom this machine trusts."""
        if not TRUSTED.exists():
            return "--network host"
        (self._folder / "pip.conf").write_text("[global]\ncert = /run/trusted.crt\n")
        return f"--network host -v {self._folder}/pip.conf:/etc/pip.conf:ro -v {TRUSTED}:/run/trusted.crt:ro"

    def close(self) -> None:
        """End and remove everything."""
        self.sh("podman rm --all --force --time 2; podman system reset --force", self._folder, check=False)
        self._keeper.kill()
        self._keeper.communicate()
