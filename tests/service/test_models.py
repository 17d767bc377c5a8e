from __future__ import annotations

import asyncio

import pytest

from gateway.core.site import Device, Site
from gateway.devices.schema import load_map
from gateway.devices.unknown import UNKNOWN
from gateway.service.models import ModelKeeper


class Faces:
    """A site that is put together anew when it is asked for."""

    def __init__(self) -> None:
        self.devices = [Device(f"array-{n}", n, n, UNKNOWN, auto=True) for n in (1, 2)]
        self.site = Site.of("ridge", (), self.devices)
        self.made = 0
        self.looks = 0

    async def show(self) -> None:
        self.made += 1
        self.site = Site.of("ridge", (), self.devices)

    async def sleep(self, _seconds: float) -> None:
        self.looks += 1
        if self.looks == 2:
            for device in self.devices:
                device.map = load_map("tristar-mppt")
        if self.looks == 5:
            raise asyncio.CancelledError


async def test_faces_are_made_anew_once_for_all_that_was_found_meanwhile() -> None:
    faces = Faces()
    with pytest.raises(asyncio.CancelledError):
        await ModelKeeper(lambda: faces.site, faces.show, faces.sleep).run()
    assert faces.made == 1
    assert faces.site.maps == (load_map("tristar-mppt"),) * 2
