"""Locks of ports in a directory of the tests, and the bench of a device."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest
from trigger_twins import TWINS, Bench

from acquire.errors import TriggerError
from acquire.trigger.transports import lock

SHARED = lock.SHARED


@pytest.fixture(autouse=True)
def _locks_of_its_own(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs of these tests at a time must not keep each other from ``loop://`` and the made-up bus."""
    monkeypatch.setattr(lock, "SHARED", tmp_path_factory.getbasetemp())


@pytest.fixture
def locks_of_the_host(_locks_of_its_own: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests in which another process must find the lock."""
    monkeypatch.setattr(lock, "SHARED", SHARED)


@pytest.fixture(params=TWINS)
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """Every twin in turn."""
    with TWINS[request.param]() as made:
        yield made
        for driver in made.drivers:
            with contextlib.suppress(TriggerError):  # a test may have pulled the plug
                driver.close()
