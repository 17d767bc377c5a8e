"""`/sd`: where Prometheus finds this gateway, and with which labels."""

from __future__ import annotations

import json

import pytest
from aiohttp import ClientSession
from hypothesis import given
from hypothesis import strategies as st

from gateway.faces.http.discovery import targets

from .conftest import Gateway

LOCAL = ("10.0.0.5", 9850)


@pytest.mark.parametrize(
    ("host", "local", "secure", "target"),
    [
        ("gateway.example:9850", LOCAL, False, "gateway.example:9850"),
        ("gateway.example", LOCAL, False, "gateway.example:80"),
        ("gateway.example", LOCAL, True, "gateway.example:443"),
        ("[2001:db8::7]:9850", LOCAL, False, "[2001:db8::7]:9850"),
        ("", LOCAL, False, "10.0.0.5:9850"),
        ('x"}], evil', LOCAL, False, "10.0.0.5:9850"),
        ("gateway/../metrics", LOCAL, False, "10.0.0.5:9850"),
        ("", ("::1", 9850), False, "[::1]:9850"),
    ],
)
def test_the_target_is_what_was_asked(host: str, local: tuple[str, int], secure: bool, target: str) -> None:
    [found] = targets("ridge-07", host, local, secure=secure)
    assert found == {
        "targets": [target],
        "labels": {"site": "ridge-07", "__scheme__": "https" if secure else "http"},
    }


@given(st.text())
def test_any_host_header_gives_one_target_without_blanks(host: str) -> None:
    [found] = targets("ridge-07", host, LOCAL, secure=False)
    [target] = found["targets"]
    assert not set(target) & set(' "{}/\\\n')


async def test_the_page(gateway: Gateway) -> None:
    async with ClientSession() as session, session.get(f"{gateway.url}/sd") as reply:
        assert reply.headers["Content-Type"].startswith("application/json")
        assert json.loads(await reply.text()) == [
            {"targets": [gateway.url.removeprefix("http://")], "labels": {"site": "ridge-07", "__scheme__": "http"}}
        ]
