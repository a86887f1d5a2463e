"""The same clients at the page's address, with a token and over TLS, and refused without."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import ipaddress
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from fake_run import FakeRun, rig_config
from page_server import PageServer
from served import api

from acquire.client import AsyncClient, Client, State
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.service import Service
from acquire.errors import NoDaemonError, StateError, UsageError


def certificate(directory: Path) -> tuple[Path, Path]:
    """For 127.0.0.1, by nobody but itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "acquire")])
    now = datetime.datetime.now(datetime.UTC)
    address = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(address, critical=False)
        .sign(key, hashes.SHA256())
    )
    paths = directory / "c.pem", directory / "k.pem"
    paths[0].write_bytes(made.public_bytes(serialization.Encoding.PEM))
    secret = serialization.NoEncryption()
    form = serialization.PrivateFormat.PKCS8
    paths[1].write_bytes(key.private_bytes(serialization.Encoding.PEM, form, secret))
    return paths


@pytest.fixture
def page(tmp_path: Path) -> Iterator[PageServer]:
    crt, key = certificate(tmp_path)
    service, socket = Service(rig_config(tmp_path), lambda _: FakeRun()), tmp_path / "c.sock"
    with (
        contextlib.closing(Endpoint(socket)) as endpoint,
        api(service, endpoint),
        contextlib.closing(PageServer(socket, tmp_path, certificate=str(crt), key=str(key))) as made,
    ):
        yield made


def test_scripts_can_control_the_instrument_remotely(
    page: PageServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = page.address.rstrip("/")
    with pytest.raises(NoDaemonError, match=r"certificate|CERTIFICATE"):
        Client(address, token=page.operator).status()
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "c.pem"))
    client = Client(address, token=page.operator)
    assert client.arm(request_id="one").state is State.ARMED
    assert client.arm(request_id="one").state is State.ARMED  # carried out once, through the page as well
    client.mark("from elsewhere")
    assert "from elsewhere" in [news.text for news in client.events(history=True, timeout_s=0)]
    with pytest.raises(StateError, match="cannot stop while armed"):
        client.stop()
    with pytest.raises(UsageError, match="a viewer's token cannot change anything"):
        Client(address, token=page.viewer).disarm()
    with pytest.raises(UsageError, match="missing or wrong"):
        Client(address).status()
    monkeypatch.setenv("ACQUIRE_TOKEN", page.viewer)

    async def look() -> State:
        async with AsyncClient(address) as other:
            return (await other.status()).state

    assert asyncio.run(look()) is State.ARMED
    client.disarm()
