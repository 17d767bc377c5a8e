"""The rows of the HTTP face: a site on a virtual clock with its metrics, and whole gateways as processes."""

from __future__ import annotations

from tests.e2e.conftest import launch, start

__all__ = ["launch", "start"]
