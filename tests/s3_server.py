"""An S3 server of its own on loopback, and what a client needs to know of it."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import boto3
import fsspec
import pytest
from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import BaseWSGIServer, make_server
from werkzeug.wrappers import Response

from acquire.store.remote import check_url

BUCKET = "recordings"
KEYS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_REGION": "us-east-1"}
DENIED = "<Error><Code>AccessDenied</Code><Message>read only</Message></Error>"


class S3Server:
    """An empty bucket that keeps what it has while the server is away. What is put waits while ``open`` is
    not set, and is refused with ``denies``."""

    def __init__(self) -> None:
        self._app = DomainDispatcherApplication(create_backend_app)
        self._port = 0
        self._server: BaseWSGIServer | None = None
        self.open = threading.Event()
        self.open.set()
        self.denies = False
        self.put_begun = threading.Event()
        """Something has been put, or waits, since the test cleared it."""

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self._port}"

    @property
    def environment(self) -> dict[str, str]:
        return {**KEYS, "AWS_ENDPOINT": self.endpoint, "AWS_ALLOW_HTTP": "true"}

    def start(self) -> None:
        """Listen; after a `stop`, where it was before."""
        if not self._port:
            forget_clients()
        self._server = make_server("127.0.0.1", self._port, self._answer, threaded=True)
        self._port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), name="s3")
        self._thread.start()

    def stop(self) -> None:
        """Nobody listens any more. Idempotent."""
        server, self._server = self._server, None
        if server is not None:
            self.open.set()
            server.shutdown()
            self._thread.join()
            server.server_close()

    @contextmanager
    def client(self) -> Iterator[Any]:
        """One that knows nothing of acquire."""
        keys = {"aws_access_key_id": "test", "aws_secret_access_key": "test", "region_name": "us-east-1"}
        made = boto3.client("s3", endpoint_url=self.endpoint, **keys)
        try:
            yield made
        finally:
            made.close()

    def create_bucket(self) -> None:
        with self.client() as client:
            client.create_bucket(Bucket=BUCKET)

    def download(self, prefix: str, to: Path) -> Path:
        """What lies below a prefix of the bucket, as files."""
        with self.client() as client:
            pages = client.get_paginator("list_objects_v2").paginate(Bucket=BUCKET, Prefix=f"{prefix}/")
            for key in [one["Key"] for page in pages for one in page.get("Contents", ())]:
                file = to / key
                file.parent.mkdir(parents=True, exist_ok=True)
                client.download_file(BUCKET, key, str(file))
        return to / prefix

    def _answer(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        if environ["REQUEST_METHOD"] in ("PUT", "POST"):
            self.put_begun.set()
            self.open.wait()
            if self.denies:
                environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
                return Response(DENIED, 403, content_type="application/xml")(environ, start_response)
        return self._app(environ, start_response)  # type: ignore[no-any-return]


def forget_clients() -> None:
    """fsspec keeps clients, and they keep the endpoint that they met first: another server's, by now."""
    check_url(f"s3://{BUCKET}")  # says whose clients they are
    fsspec.get_filesystem_class("s3").clear_instance_cache()


@contextmanager
def s3_server(patch: pytest.MonkeyPatch) -> Iterator[str]:
    """URL of an empty bucket, with the environment that leads to it."""
    server = S3Server()
    server.start()
    try:
        for name, value in server.environment.items():
            patch.setenv(name, value)
        server.create_bucket()
        yield f"s3://{BUCKET}"
    finally:
        server.stop()
