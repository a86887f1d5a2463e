"""Values that the library cannot use end in an error that says what is possible, not in one of numpy's."""

from __future__ import annotations

from collections.abc import Callable
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquire.client import Client
from acquire.codes import ConstantCode, ListedCode, PrbsCode, code_from_attrs, state_at
from acquire.config import load_rig, load_scene
from acquire.errors import UsageError
from acquire.recon import reconstruct
from acquire.recon.segments import Voxels
from acquire.reconstruct import by_lines, by_time, in_glimpses, in_voxels
from acquire.simulate import bench_of, simulate, study
from acquire.store import Recording, mirror, open_recording, open_video, recover, verify

PRBS = PrbsCode.from_seed(16, 1)
LISTED = ListedCode.of(np.array([1, 0, 1], np.uint8))

OF_CODES: dict[str, tuple[Callable[[], Any], str]] = {
    "degree": (lambda: PrbsCode.from_seed(-1, 1), "no prbs code of degree -1; possible: 3, 4"),
    "seed": (lambda: PrbsCode.from_seed(16, 1.5), r"the seed 1\.5; possible: an integer"),  # type: ignore[arg-type]
    "state": (lambda: PrbsCode(16, 1.5), r"the state 1\.5; possible: 1 to 0xffff"),  # type: ignore[arg-type]
    "text": (lambda: PrbsCode(16, "1"), "the state '1'; possible"),  # type: ignore[arg-type]
    "prbs": (lambda: PRBS.bits(0, -1), "start = 0 and length = -1; possible: integers, length 0 or more"),
    "constant": (lambda: ConstantCode(1).bits(0, -1), "length = -1; possible"),
    "listed": (lambda: LISTED.bits(0, -1), "length = -1; possible"),
    "start": (lambda: PRBS.bits(0.5, 3), r"start = 0\.5 and length = 3; possible"),  # type: ignore[arg-type]
    "index": (lambda: state_at(16, 1, -1), "start = -1 .*start and length 0 or more"),
    "two": (lambda: ListedCode.of(np.array([1, 2])), "not a list of code bits; possible: .* 0 and 1"),
    "float": (lambda: ListedCode.of(np.array([0.0, 1.0])), "dtype float64 is not a list of code bits"),
    "square": (lambda: ListedCode.of(np.eye(3, dtype=int)), r"shape \(3, 3\) and dtype int64 is not a list"),
    "no degree": (lambda: code_from_attrs({"kind": "prbs"}), "describes no code: KeyError: 'degree'; poss"),
    "no value": (lambda: code_from_attrs({"kind": "constant"}), "describes no code: KeyError"),
    "no bits": (lambda: code_from_attrs({"kind": "bits"}), "describes no code: KeyError"),
    "none": (lambda: code_from_attrs(None), "code attribute None describes no code"),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("name", OF_CODES)
def test_of_codes(name: str) -> None:
    make, words = OF_CODES[name]
    with pytest.raises(UsageError, match=words):
        make()


def test_numpys_integers_are_integers() -> None:
    assert PRBS.bits(np.int64(0), np.int64(4)).tolist() == PRBS.bits(0, 4).tolist()  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("bad") / "r.zarr"
    simulate(load_rig("rig-demo", {"geometry.stages": 8}), load_scene("scene-leds"), path, 60)
    return open_recording(path)


OF_LINES: dict[str, tuple[Callable[[Any], Any], str]] = {
    "cut": (lambda r: r.cut(0.5, 10), r"first_line cannot be 0\.5; possible: an integer; try: int"),
    "cut lines": (lambda r: r.cut(0, 10.0), r"lines cannot be 10\.0; possible"),
    "cut text": (lambda r: r.cut("0", 10), "first_line cannot be '0'; possible"),
    "cut none": (lambda r: r.cut(0, None), "lines cannot be None; possible"),
    "whole lines": (lambda r: r.whole_lines(0.5, 10), r"first_line cannot be 0\.5; possible"),
    "by lines": (lambda r: by_lines(r, 0.5, 10), r"first_line cannot be 0\.5; possible"),  # type: ignore[arg-type]
    "by lines text": (lambda r: by_lines(r, "0", 10), "first_line cannot be '0'; possible"),  # type: ignore[arg-type]
    "no lines": (lambda r: r.cut(5, 0), "a range of 0 lines cannot be read; possible: 1 or more"),
    "by no lines": (
        lambda r: by_lines(r, 5, 0),
        "a range of 0 lines cannot be selected; possible: 1 or more",
    ),
    "by time": (lambda r: by_time(r, nan, None), "begin_ns cannot be nan; possible: nanosec"),  # type: ignore[arg-type]
    "longest": (
        lambda r: in_voxels(by_lines(r), Voxels(6, 10), longest=0),
        "sub-segments of 0 sub-steps are not possible; possible: 1 or more",
    ),
    "glimpses": (
        lambda r: in_glimpses(by_lines(r), Voxels(6, 10), 0),
        "0 glimpses are not possible; possible: 1 or more",
    ),
    "glimpses of nothing": (lambda r: in_glimpses(by_lines(r), Voxels(6, 0), 3), "merge T_m = 0 is out of"),
    "a recording": (lambda r: reconstruct(r, 6, 10), r"a Recording cannot be .*try: recording\.cut\("),
}


@pytest.mark.parametrize("name", OF_LINES)
def test_of_lines(recording: Recording, name: str) -> None:
    make, words = OF_LINES[name]
    with pytest.raises(UsageError, match=words):
        make(recording)


OF_TYPES: dict[str, tuple[Callable[[Any], Any], str]] = {
    "recording": (lambda _: open_recording(5), "^5 cannot be a path; possible: a Path, or text"),  # type: ignore[arg-type]
    "bytes": (lambda _: open_recording(b"x"), "^b'x' cannot be a path"),  # type: ignore[arg-type]
    "zero": (lambda _: open_recording("a\0b"), r"^'a\\x00b' cannot be a path"),
    "video": (lambda _: open_video(None), "^None cannot be a path"),  # type: ignore[arg-type]
    "verify": (lambda _: verify(5), "^5 cannot be a path"),  # type: ignore[arg-type]
    "recover": (lambda _: recover(5), "^5 cannot be a path"),  # type: ignore[arg-type]
    "mirror": (lambda _: mirror(5, "memory://x"), "^5 cannot be a path"),  # type: ignore[arg-type]
    "rig": (lambda _: load_rig(5), "^5 cannot be a rig file; possible: a path"),  # type: ignore[arg-type]
    "scene": (lambda _: load_scene(None), "^None cannot be a scene file; possible"),  # type: ignore[arg-type]
    "overrides": (lambda _: load_rig("rig-demo", ["x=1"]), r"^\['x=1'\] cannot override"),  # type: ignore[arg-type]
    "key": (lambda _: load_rig("rig-demo", {5: 5}), "^{5: 5} cannot override"),  # type: ignore[dict-item]
    "lines of": (lambda _: by_lines("r"), "^lines of 'r' cannot be selected; .*try: open_recording"),  # type: ignore[arg-type]
    "time": (lambda r: by_time(r, "5", None), "begin_ns cannot be '5'; possible"),  # type: ignore[arg-type]
    "length": (lambda r: in_voxels(by_lines(r), Voxels(6, 10), longest="5"), "longest cannot be '5'; poss"),  # type: ignore[arg-type]
    "number": (lambda r: in_glimpses(by_lines(r), Voxels(6, 10), "5"), "count cannot be '5'; possible"),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("name", OF_TYPES)
def test_of_types(recording: Recording, name: str) -> None:
    make, words = OF_TYPES[name]
    with pytest.raises(UsageError, match=words):
        make(recording)


def test_of_models_and_paths(tmp_path: Path) -> None:
    rig, scene = load_rig("rig-demo", {"geometry.stages": 8}), load_scene("scene-leds")
    for given, words in (
        (("rig-demo", scene, tmp_path / "r.zarr"), r"^'rig-demo' cannot be simulated; .*try: load_rig\("),
        ((rig, "scene-leds", tmp_path / "r.zarr"), r"^'scene-leds' cannot be simulated; .*try: load_scene\("),
        ((rig, scene, 5), "^5 cannot be a path"),
    ):
        with pytest.raises(UsageError, match=words):
            simulate(*given, 60)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
    # a text is as good as a Path
    simulate(rig, scene, f"{tmp_path}/r.zarr", 60)
    assert mirror(f"{tmp_path}/r.zarr", f"file://{tmp_path}/far.zarr").sealed
    assert not recover(f"{tmp_path}/far.zarr").damage


def test_of_simulations(tmp_path: Path) -> None:
    rig, scene = load_rig("rig-demo", {"geometry.stages": 8}), load_scene("scene-leds")
    with pytest.raises(UsageError, match=r"lines cannot be 1\.5; possible: an integer"):
        simulate(rig, scene, tmp_path / "r.zarr", 1.5)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="a study of 0 lines is not possible; possible: 1 or more"):
        study(bench_of(rig, scene), rig.code.build(), 0)
    assert not list(tmp_path.iterdir())


OF_CLIENTS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "lines": (lambda c: c.start(lines=-5), r"start: lines = -5: must be greater"),
    "seconds": (
        lambda c: c.start(duration_s="x"),
        r"start: duration_s = 'x': must be a valid number",
    ),
    "two": (lambda c: c.start(lines=5, duration_s=1.0), r"^start: lines and duration_s exclude each other"),
    "path": (lambda c: c.start(5), r"start: path = 5: Input is not a valid path"),
    "name": (lambda c: c.start("a\udcff.zarr"), r"^start: path '.*a\\udcff\.zarr' is not UTF-8"),
    "code": (lambda c: c.arm(code="blue"), r"arm: code = 'blue': must be 'rig', 'dark' or 'steady'"),
    "delays": (lambda c: c.arm(delays={"a": 1}), r"^arm: delays\.light_lead: Field required"),
    "text": (lambda c: c.mark(5), r"mark: text = 5: must be a valid string"),
    "id": (
        lambda c: c.mark("", request_id="a b"),
        r"mark: request_id = 'a b' is not a request id; possible: 1 to",
    ),
    "id of news": (lambda c: next(c.events("€")), r"last_id = '€' is not the id of news"),
    "state": (
        lambda c: c.wait({"ready"}, 1),
        r"wait: 'ready' is not a state to wait for; possible: idle, armed",
    ),
    "no state": (lambda c: c.wait((), 1), r"wait: there is no state to wait for"),
    "address": (lambda _: Client(5), r"^5 is not a valid address; possible"),  # type: ignore[arg-type]
    "token": (lambda _: Client("http://x", token="a\nb"), r"^the token is not text that a header can hold"),
}


@pytest.mark.parametrize("name", OF_CLIENTS)
def test_of_clients(name: str, tmp_path: Path) -> None:
    """Before anything is sent: nobody listens."""
    make, words = OF_CLIENTS[name]
    with pytest.raises(UsageError, match=words):
        make(Client(tmp_path / "none.sock"))


@pytest.mark.parametrize(
    "place",
    [
        "http://[::1",
        "ftp://host:80",
        "http://host:99999",
        "http://",
        f"http://{'a' * 64}",
        "http://a..b:80",
        "http://a\0b",
    ],
)
def test_of_addresses(place: str) -> None:
    with pytest.raises(UsageError, match="is not a valid address; possible: http://HOST:PORT, or a socket"):
        Client(place)
