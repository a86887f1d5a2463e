"""The API over a service whose capture path is the test's, on a real socket."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_run import FakeRun, rig_config
from served import api

from acquire.client import Client
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.service import Service


@pytest.fixture
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("s") / "c.sock"


@pytest.fixture
def run() -> FakeRun:
    """What `arm` opens."""
    return FakeRun()


@pytest.fixture
def service(path: Path, run: FakeRun) -> Service:
    return Service(rig_config(path.parent), lambda _: run)


@pytest.fixture
def daemon(path: Path, service: Service) -> Iterator[Client]:
    with contextlib.closing(Endpoint(path)) as endpoint, api(service, endpoint), Client(path) as client:
        yield client
