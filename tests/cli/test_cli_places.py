"""Exit code 6 means that data is lost or damaged, never that a path or URL holds none."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from s3_server import KEYS, S3Server

from acquire.cli.demo import capture
from acquire.cli.demo.plan import DemoPlan
from acquire.cli.journal import StepJournal
from acquire.cli.usage import not_installed
from acquire.errors import NoDaemonError
from acquire.store import write_video
from acquire.store.remote import WAYS_IN, RemoteSource

Cli = Callable[..., Any]

READERS = {
    "replay": ("replay", "{place}", "--out", "new.zarr"),
    "info": ("info", "{place}"),
    "verify": ("verify", "{place}"),
    "cut": ("cut", "{place}", "--first-line", "1", "--lines", "1", "--out", "new.npz"),
    "reconstruct": ("reconstruct", "{place}", "--out", "new.zarr"),
    "auto": ("reconstruct", "{place}", "--auto"),
    "tradeoff": ("tradeoff", "{place}", "--out", "new"),
    "render": ("render", "{place}", "--out", "new.png"),
}
"""Commands that take a path or a URL."""
CHANGERS = {
    "recover": ("recover", "{place}"),
    "hold": ("hold", "{place}", "--first-line", "1", "--lines", "1"),
    "upload": ("upload", "{place}", "memory://copies/new.zarr"),
}
"""Commands that take a path alone."""
FILES = {
    "simulate": ("simulate", "{place}", "--out", "new.zarr"),
    "config": ("config", "check", "{place}"),
    "serve": ("serve", "--config", "{place}"),
    "bench": ("bench", "--config", "{place}"),
    "devices": ("devices", "--config", "{place}"),
    "demo": ("demo", "--config", "{place}", "--out", "new"),
    "plan": ("reconstruct", "none.zarr", "--plan", "{place}", "--out", "new.zarr"),
    "code": ("trigger", "load", "{place}"),
    "ls": ("ls", "{place}"),
}
"""Commands that take another kind of file, or a directory."""
NO_RECORDINGS = ("absent", "below a file", "file", "empty file", "directory", "group", "too long", "nul")
NO_FILES = ("absent", "below a file", "file", "too long")


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Paths without a recording, by kind."""
    monkeypatch.chdir(tmp_path)
    there = tmp_path / "there"
    (there / "directory").mkdir(parents=True)
    (there / "file").write_text("root:x:0:0\n")
    (there / "empty").touch()
    (there / "directory" / "link").symlink_to(there / "file")
    zarr.create_group(there / "group", zarr_format=3)
    return {
        "absent": str(there / "absent.zarr"),
        "below a file": str(there / "file" / "x.zarr"),
        "file": str(there / "file"),
        "empty file": str(there / "empty"),
        "directory": str(there / "directory"),
        "group": str(there / "group"),
        "too long": str(there / ("long" * 100)),
        "nul": str(there / "a") + "\udcff.zarr",
    }


def untouched(directory: Path) -> bool:
    """Return whether nothing was created."""
    return {path.name for path in directory.iterdir()} <= {"there"}


@pytest.mark.parametrize("what", NO_RECORDINGS)
@pytest.mark.parametrize("words", [*READERS.values(), *CHANGERS.values()], ids=[*READERS, *CHANGERS])
def test_a_path_that_is_not_a_recording_is_a_wrong_path_not_damage(
    cli: Cli, tmp_path: Path, places: dict[str, str], words: tuple[str, ...], what: str
) -> None:
    answer = cli(*(word.format(place=places[what]) for word in words))
    assert answer.code == 2, answer.err
    shown = Path(places[what]).name.partition("\udcff")[0][-40:]  # the middle of a long name is left out
    assert shown in answer.err
    assert "  try: " in answer.err or "  possible: " in answer.err
    assert untouched(tmp_path)


@pytest.mark.parametrize("what", NO_FILES)
@pytest.mark.parametrize("words", FILES.values(), ids=FILES)
def test_a_path_without_the_expected_file_is_a_wrong_path(
    cli: Cli, tmp_path: Path, places: dict[str, str], words: tuple[str, ...], what: str
) -> None:
    answer = cli(*(word.format(place=places[what]) for word in words))
    assert answer.code == 2, answer.err
    assert "Traceback" not in answer.err
    assert untouched(tmp_path)


@pytest.mark.needs_user
@pytest.mark.parametrize("words", [*READERS.values(), *CHANGERS.values()], ids=[*READERS, *CHANGERS])
def test_unreadable_files_are_reported_as_such(
    cli: Cli, places: dict[str, str], words: tuple[str, ...]
) -> None:
    closed = Path(places["group"])
    closed.chmod(0)
    try:
        answer = cli(*(word.format(place=closed) for word in words))
    finally:
        closed.chmod(0o700)
    assert (answer.code, "Permission denied" in answer.err) == (2, True)


def test_a_video_is_distinguished_from_a_recording(cli: Cli, tmp_path: Path) -> None:
    times = np.arange(2, dtype=np.int64)
    write_video(
        tmp_path / "v.zarr",
        np.zeros((2, 4, 4), np.float32),
        times,
        pixel_size=1.0,
        frame_interval_ns=1e4,
        provenance={},
    )
    answer = cli("info", tmp_path / "v.zarr")
    assert (answer.code, "is a video, but not a recording" in answer.err) == (2, True)
    assert "try: acquire render" in answer.err


@pytest.fixture(scope="module")
def server() -> Iterator[S3Server]:
    """One server for all tests here, since a client keeps its event loop for the life of the process."""
    made = S3Server()
    made.start()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in made.environment.items():
            patch.setenv(name, value)
        made.create_bucket()
        RemoteSource("s3://recordings").put("made", b"once")
    try:
        yield made
    finally:
        made.stop()


def closed_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@pytest.mark.parametrize("family", sorted(WAYS_IN))
@pytest.mark.parametrize("words", READERS.values(), ids=READERS)
def test_a_store_without_credentials_is_refused_without_a_request(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], family: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in {name for way in WAYS_IN[family] for name in way}:
        monkeypatch.delenv(name, raising=False)

    def asked(*_: object) -> None:
        raise AssertionError("somebody was asked")

    monkeypatch.setattr("fsspec.core.url_to_fs", asked)
    answer = cli(*(word.format(place=f"{family}://bucket/x.zarr") for word in words))
    assert answer.code == 2, answer.err
    assert "the environment holds no credentials" in answer.err
    assert f"  try: export {WAYS_IN[family][0][0]}" in answer.err


@pytest.mark.parametrize("words", READERS.values(), ids=READERS)
def test_a_missing_bucket_or_name_is_a_wrong_url(
    cli: Cli,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    server: S3Server,
    words: tuple[str, ...],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    for place in ("s3://recordings/none.zarr", "s3://nobucketofthisname/none.zarr"):
        answer = cli(*(word.format(place=place) for word in words))
        assert (answer.code, place in answer.err) == (2, True), answer.err
    assert untouched(tmp_path)


def test_upload_errors(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, server: S3Server) -> None:
    """Missing rights or buckets are user errors, a missing network is the host's; nothing is lost."""
    from test_cli_recordings import write

    recording = write(tmp_path / "one.zarr")
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    server.denies = True
    try:
        denied = cli("upload", recording, "s3://recordings/one.zarr")
    finally:
        server.denies = False
    assert denied.code == 2, denied.err
    assert "AWS_ACCESS_KEY_ID" in denied.err
    unknown = cli("upload", recording, "s3://nobucketofthisname/one.zarr")
    assert unknown.code == 2, unknown.err
    monkeypatch.setenv("AWS_ENDPOINT", f"http://127.0.0.1:{closed_port()}")
    away = cli("upload", recording, "s3://away/one.zarr")
    assert away.code == 5, away.err
    assert "try: the network" in away.err
    for name in KEYS:
        monkeypatch.delenv(name)
    without = cli("upload", recording, "s3://recordings/one.zarr")
    assert (without.code, "holds no credentials" in without.err) == (2, True)


@pytest.mark.parametrize("words", CHANGERS.values(), ids=CHANGERS)
def test_a_command_that_changes_a_recording_in_place_takes_no_url(cli: Cli, words: tuple[str, ...]) -> None:
    answer = cli(*(word.format(place="s3://bucket/x.zarr") for word in words))
    assert (answer.code, "possible: a path on this machine" in answer.err) == (2, True)


@pytest.mark.parametrize(
    ("command", "module", "brought"),
    [
        ("info", "obstore", "tdi-acquire[remote]"),
        ("reconstruct", "scipy", "tdi-acquire[reconstruct]"),
        ("simulate", "numba", "tdi-acquire[simulate]"),
        ("demo", "numba", "tdi-acquire[report]"),
        ("calibrate", "matplotlib", "tdi-acquire[report]"),
        ("web", "PIL", "tdi-acquire[web]"),
        ("info", "elsewhere", "elsewhere"),
    ],
)
def test_a_missing_package_is_named_with_the_extra_that_installs_it(
    monkeypatch: pytest.MonkeyPatch, command: str, module: str, brought: str
) -> None:
    monkeypatch.setattr("sys.argv", ["acquire", command, "run.zarr"])
    error = not_installed(ModuleNotFoundError(f"No module named {module!r}", name=module))
    assert (error.exit_code, error.hint.replace("'", "")) == (2, f"pip install {brought}")
    assert module in error.message


def test_a_demo_has_a_socket_wherever_temporary_files_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = tmp_path / ("x" * 100)
    deep.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(deep))
    asked: list[Path] = []

    @contextmanager
    def no_daemon(_: DemoPlan, path: Path) -> Iterator[None]:
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(path))  # raises for a path that is too long
        asked.append(path)
        raise NoDaemonError("enough")
        yield

    monkeypatch.setattr(capture, "daemon", no_daemon)
    with pytest.raises(NoDaemonError, match="enough"):
        capture.record(DemoPlan(tmp_path), StepJournal())
    assert not asked[0].parent.exists()


def npy(array: np.ndarray) -> bytes:
    file = BytesIO()
    np.save(file, array)
    return file.getvalue()


CODES = {
    "empty": b"",
    "an archive": b"PK\x03\x04 and no more",
    "records": npy(np.zeros(3, [("bit", np.uint8)])),
    "complex": npy(np.array([0, 1, 1j])),
}


@pytest.mark.parametrize("command", ["ls", "info", "verify", "recover", "hold", "diagnose"])
def test_an_empty_path_is_not_the_current_directory(cli: Cli, command: str) -> None:
    """As of a variable that is not set: `acquire ls ""` listed the current directory."""
    answer = cli(command, "")
    assert answer.code == 2
    assert "the path is empty" in answer.err


@pytest.mark.parametrize("content", CODES.values(), ids=CODES)
def test_a_file_without_a_code_is_refused_in_words(cli: Cli, tmp_path: Path, content: bytes) -> None:
    """Each ended in a traceback of NumPy or zipfile, but for complex numbers."""
    (tmp_path / "code.npy").write_bytes(content)
    answer = cli("trigger", "load", str(tmp_path / "code.npy"))
    assert answer.code == 2, answer.err
    assert "code.npy" in answer.err
    assert "Traceback" not in answer.err


@pytest.mark.parametrize("out", [".", "/"])
def test_a_rendering_needs_a_name(cli: Cli, out: str) -> None:
    """The hint, another suffix for a name that there is not, ended in a traceback."""
    answer = cli("render", "video.zarr", "--out", out)
    assert answer.code == 2, answer.err
    assert f"{out} cannot be rendered: its name has no suffix" in answer.err


def test_a_port_that_does_not_exist_is_named_with_its_option(cli: Cli) -> None:
    """pydantic's words alone did not say which value they are about."""
    answer = cli("web", "--link", "--port", 99_999)
    assert answer.code == 2
    assert "--port 99999: " in answer.err


def test_what_lists_a_directory_takes_no_url_of_another_machine(cli: Cli, tmp_path: Path) -> None:
    answer = cli("ls", "s3://bucket/recordings/")
    assert (
        "s3://bucket/recordings/ is a URL, but `acquire ls` lists a directory of this machine" in answer.err
    )
    assert "acquire info s3://bucket/recordings/NAME.zarr describes one" in answer.err
    assert "no recordings" in cli("ls", f"file://{tmp_path}").out
