"""A run that the host cannot record is refused before anything is touched, with numbers."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acquire.capacity.load import Load
from acquire.capacity.parts import Pace, Parts
from acquire.config import load_rig
from acquire.daemon import proof
from acquire.daemon.messages import ArmRequest, CapacityStatus
from acquire.daemon.plan import Run
from acquire.daemon.proof import Proof
from acquire.daemon.service import Service
from acquire.daemon.states import State
from acquire.errors import ConfigError, UsageError
from acquire.rig import Rig
from acquire.store import open_recording
from acquire.stream.messages import Begin


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A host whose recorder takes ``rate`` lines per second, or ``rates`` one after the other, at ``cpu``
    seconds of processor per line; how often it was asked.
    """
    found: dict[str, Any] = {"rate": 1e6, "rates": [], "times": 0, "cpu": 1e-9}

    def measure(load: object, directory: Path) -> Parts:
        found["times"] += 1
        rates = found["rates"] or [found["rate"]]
        fast, slow = Pace(1e9, 1e-9), Pace(rates.pop(0) if found["rates"] else rates[0], found["cpu"])
        return Parts(load, ring=fast, codec=fast, recorder=slow, cores=2)  # type: ignore[arg-type]

    monkeypatch.setattr(proof, "measure_parts", measure)
    return found


def make_proof(directory: Path, *, real: bool = True) -> Proof:
    drivers = {f"cameras.{arm}.driver": "aravis" for arm in "ab"} if real else {}
    return Proof(load_rig("rig-demo", {"recording.directory": str(directory), **drivers}))


def test_a_sufficient_rate_is_measured_once(measured: dict[str, Any], tmp_path: Path) -> None:
    prove = make_proof(tmp_path)
    whole = [prove(force=False) for _ in range(3)]
    for found in whole:
        assert (found.sustained_hz, found.limit, found.warning) == (1_000_000, "recorder", None)
    assert measured["times"] == 1
    assert len({found.measured for found in whole}) == 1, "how old the number is"
    assert whole[0].measured is not None
    time.sleep(0.001)
    assert (again := prove(force=False, fresh=True).measured) is not None
    assert again > whole[0].measured


def test_a_codec_that_does_not_give_lines_back_is_no_lack_of_a_measurement(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def measure(load: object, directory: Path) -> Parts:
        raise ConfigError("codec 'lossy' has unpacked other bytes than it was given", hint="another")

    monkeypatch.setattr(proof, "measure_parts", measure)
    with pytest.raises(ConfigError, match="other bytes"):
        make_proof(tmp_path)(force=True)


def test_what_is_old_is_measured_again(
    measured: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prove = make_proof(tmp_path)
    prove(force=False)
    monkeypatch.setattr(proof, "VALID_S", 0.0)
    prove(force=False)
    assert measured["times"] == 2


def test_a_rate_above_it_is_refused_unless_forced(measured: dict[str, Any], tmp_path: Path) -> None:
    measured["rate"] = 20_000.0
    prove = make_proof(tmp_path)
    said: list[str] = []
    with pytest.raises(UsageError) as refused:
        prove(force=False, progress=said.append)
    assert "33333.3 lines/s" in refused.value.message
    assert "20000 lines/s, limited by recorder" in refused.value.possible
    assert "best of 3 measurements at a load of" in refused.value.possible
    assert "--force" in refused.value.hint
    assert [words.split(" (")[0] for words in said] == [
        "measuring what this host sustains",
        "measuring what this host sustains, 2 of 3",
        "measuring what this host sustains, 3 of 3",
    ]
    assert "33333.3" in str(prove(force=True).warning)


def test_one_disturbed_measurement_refuses_nothing(measured: dict[str, Any], tmp_path: Path) -> None:
    measured["rates"] = [8_000.0, 9_000.0, 200_000.0]
    assert make_proof(tmp_path)(force=False).sustained_hz == 200_000
    assert measured["times"] == 3


def test_a_refusal_is_not_remembered(measured: dict[str, Any], tmp_path: Path) -> None:
    prove = make_proof(tmp_path)
    measured["rate"] = 8_000.0
    with pytest.raises(UsageError):
        prove(force=False)
    measured["rate"] = 200_000.0
    assert prove(force=False).sustained_hz == 200_000
    assert (prove(force=False).sustained_hz, measured["times"]) == (
        200_000,
        4,
    )  # what is enough is remembered


def test_simulated_cameras_wait_for_a_busy_host_but_not_for_one_too_small(
    measured: dict[str, Any], tmp_path: Path
) -> None:
    prove = make_proof(tmp_path, real=False)
    measured["rate"] = 8_000.0
    assert "limited by recorder" in str(prove(force=False).warning)
    measured["cpu"] = 1e-3  # seconds of processor for a line: no load is to blame
    with pytest.raises(UsageError, match="more than this host sustains"):
        prove(force=False)


def test_a_rate_close_to_it_is_a_warning(measured: dict[str, Any], tmp_path: Path) -> None:
    measured["rate"] = 40_000.0
    assert "limited by recorder" in str(make_proof(tmp_path)(force=False).warning)


def test_where_nothing_can_be_written_nothing_is_proved(tmp_path: Path) -> None:
    found = make_proof(tmp_path / "absent")(force=False)
    assert found.sustained_hz is None
    assert "does not exist" in str(found.warning)


def test_the_service_stays_idle_and_asks_no_device(tmp_path: Path) -> None:
    def too_slow(*, force: bool, progress: Callable[[str], object]) -> CapacityStatus:
        raise UsageError(f"too slow, {force}")

    def no_run(request: object) -> None:
        raise AssertionError("devices were opened")

    service = Service(load_rig("rig-demo"), no_run, prove=too_slow)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="too slow, True"):
        service.arm(ArmRequest(force=True))
    assert service.status().state is State.IDLE


def test_the_codec_that_is_chosen_is_the_one_that_is_measured(tmp_path: Path) -> None:
    """Both are measured here, with nothing in their place; the run records with the same choice."""
    settings = {"recording.directory": str(tmp_path), "recording.codec": "auto", "code.seed": 7}
    config = load_rig("rig-demo", settings)
    prove = Proof(config)
    found = prove(force=True)
    choice = prove.choose(config)
    assert found.codec == choice.codec != "none"  # photon noise packs well, and 8 MB/s are few
    with Rig(config) as rig:
        run = Run(config, rig, prove.choose)
        try:
            run.arm()
            run.capture.start(Begin(tmp_path / "r.zarr", run.spec(), 1000))
        finally:
            run.capture.close()
    attributes = open_recording(tmp_path / "r.zarr").attrs
    assert attributes["codec_choice"] == json.loads(json.dumps(choice.to_attrs()))


def test_a_load_without_a_chosen_codec_is_refused(tmp_path: Path) -> None:
    config = load_rig("rig-demo", {"recording.codec": "auto", "recording.directory": str(tmp_path)})
    with pytest.raises(UsageError, match="codec 'auto'"):
        Load.of(config)
    gone = load_rig("rig-demo", {"recording.codec": "auto", "recording.directory": str(tmp_path / "gone")})
    assert "cannot be measured" in str(Proof(gone)(force=False).warning)
