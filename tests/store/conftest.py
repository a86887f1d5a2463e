"""One S3 server for the session: clients of fsspec keep the endpoint that they met first."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from s3_server import s3_server

from acquire.store.remote import RemoteSource


@pytest.fixture(scope="session")
def bucket() -> Iterator[str]:
    """URL of a bucket. Clients keep their event loops for the life of the process: they are made here."""
    with pytest.MonkeyPatch.context() as patch, s3_server(patch) as url:
        RemoteSource(url).put("made", b"once")
        assert RemoteSource(url).read("made") == b"once"
        yield url
