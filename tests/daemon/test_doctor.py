"""What a host lacks is named, with what to do; what the rig does not need is no lack."""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from fake_run import rig_config
from waiting import until

import acquire
from acquire.client import Client
from acquire.config import RigConfig
from acquire.daemon import doctor
from acquire.daemon.checkup import examine_running
from acquire.daemon.disk_watch import disk_watch
from acquire.daemon.doctor import CheckResult, examine
from acquire.daemon.service import Service


def found(rig: RigConfig | None, name: str, running: str | None = None) -> CheckResult:
    (one,) = [one for one in examine(rig, running) if one.name == name]
    return one


def test_every_lack_says_what_to_do(tmp_path: Path) -> None:
    for one in examine(rig_config(tmp_path), None):
        assert one.text
        assert one.level == "good" or one.todo or one.name == "clock"


def test_a_foreign_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As pip leaves it: what is installed says which files are its own."""
    assert found(None, "package").level == "good"
    about = tmp_path / "acquire_imaging-0.3.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: acquire-imaging\nVersion: 0.3.0\n")
    (about / "RECORD").write_text("acquire/__init__.py,,\n")
    (tmp_path / "acquire").mkdir()
    (tmp_path / "acquire/__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    one = found(None, "package")
    assert (one.level, "pip uninstall acquire-imaging" in one.todo) == ("bad", True)
    assert one.text.startswith("acquire-imaging installs a package `acquire`, too")


def test_limits_are_judged_by_what_the_rig_asks_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits = {resource.RLIMIT_RTPRIO: (0, 0), resource.RLIMIT_NOFILE: (256, 256)}
    monkeypatch.setattr(doctor.resource, "getrlimit", limits.__getitem__)
    monkeypatch.setattr(doctor.os, "geteuid", lambda: 1000)
    assert found(rig_config(tmp_path), "real time").level == "warning"
    assert found(rig_config(tmp_path, **{"stream.realtime": True}), "real time").level == "bad"
    assert "LimitNOFILE" in found(None, "descriptors").todo


def test_sessions_that_share_the_processors_are_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "sessions_share", lambda: True)
    one = found(rig_config(tmp_path), "sessions")
    assert (one.level, "sched_autogroup_enabled=0" in one.todo) == ("warning", True)
    assert found(rig_config(tmp_path, **{"stream.realtime": True}), "sessions").level == "good"
    monkeypatch.setattr(doctor, "sessions_share", lambda: False)
    assert found(rig_config(tmp_path), "sessions").level == "good"


def test_memory_is_held_against_the_rings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert found(rig_config(tmp_path), "memory").level == "good"
    monkeypatch.setattr(doctor, "available_bytes", lambda: 10**6)
    assert found(rig_config(tmp_path), "memory").level == "bad"


def test_the_disk_is_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert found(rig_config(tmp_path), "disk").level in ("good", "warning")
    assert "not a directory" in found(rig_config(tmp_path / "none"), "disk").text
    monkeypatch.setattr(doctor, "_file_system", lambda _: "nfs4")
    assert "waits for a network" in found(rig_config(tmp_path), "disk").text


def test_copies_on_the_disk_of_the_recordings_are_warned_of_and_fill_it_as_well(tmp_path: Path) -> None:
    apart = rig_config(tmp_path)
    beside = rig_config(tmp_path, **{"recording.upload_to": f"file://{tmp_path}/copies/of"})
    one = found(beside, "uploads")
    assert (one.level, "every line takes its room twice" in one.text) == ("warning", True)
    elsewhere = rig_config(tmp_path, **{"recording.upload_to": "file:///proc/copies"})
    assert not [one for rig in (apart, elsewhere) for one in examine(rig, None) if one.name == "uploads"]
    rates = [disk_watch(rig)._expected for rig in (apart, elsewhere, beside)]
    assert rates == [rates[0], rates[0], 2 * rates[0]]


def test_a_mount_with_a_space_in_its_name_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    mounts = "/dev/sda / ext4 rw 0 0\nserver:/x /mnt/lab\\040disk nfs4 rw 0 0"
    monkeypatch.setattr(doctor, "_read", lambda _: mounts)
    assert doctor._file_system(Path("/mnt/lab disk/runs")) == "nfs4"
    assert doctor._file_system(Path("/mnt/lab")) == "ext4"


def test_a_page_on_ipv6_is_warned_of_where_the_host_has_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The socket itself is refused there, which ended the whole examination."""

    class Ipv4(socket.socket):
        def __init__(self, family: int = -1, *rest: int) -> None:
            if family == socket.AF_INET6:
                raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")
            super().__init__(family, *rest)

    monkeypatch.setattr("acquire.daemon.doctor.socket.socket", Ipv4)
    one = found(rig_config(tmp_path, **{"web.host": "::1", "web.port": 8080}), "page")
    assert (one.level, one.text) == ("warning", "::1:8080: Address family not supported by protocol")


def test_a_port_that_is_taken_and_a_daemon_of_another_version(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        rig = rig_config(tmp_path, **{"web.port": taken.getsockname()[1]})
        assert found(rig, "page").level == "warning"
    assert found(None, "daemon", "0.0.9").level == "warning"


def test_a_daemon_that_runs_is_examined_by_its_own_setup(
    daemon: Client, service: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rings of an armed run are there already, and its page has the port."""
    monkeypatch.setattr(doctor, "available_bytes", lambda: 1000)
    taken = rig_config(service.config.recording.directory, **{"web.port": 1, "stream.realtime": True})
    service.reconfigure(taken, "")
    service._disk.check(recording=False)
    until(lambda: service.status().disk is not None, "the disk")

    def now() -> dict[str, CheckResult]:
        return {one.name: one for one in examine_running(daemon.setup(), daemon.status())}

    idle = now()
    assert (idle["memory"].level, "page" in idle) == ("bad", False)
    assert str(service.config.recording.directory) in idle["disk"].text
    assert "is running" in idle["daemon"].text
    daemon.arm()
    assert now()["memory"].level == "good"


def test_producers_of_cameras_are_looked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {f"cameras.{arm}.{key}": value for arm in "ab" for key, value in (("driver", "harvesters"),)}
    rig = rig_config(tmp_path, **settings)
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(tmp_path))
    assert found(rig, "producer").level == "bad"
    (tmp_path / "maker.cti").touch()
    assert found(rig, "producer").level == "good"


def test_the_command_opens_the_devices_and_ends_with_5_for_what_is_bad(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "acquire", "doctor", "--json", "--socket", str(tmp_path / "none.sock")]
    ended = subprocess.run(
        [*words, "--config", "rig-demo"], capture_output=True, text=True, timeout=300, check=False
    )
    names = {one["name"]: one["level"] for one in json.loads(ended.stdout)}
    assert {"trigger", "camera a", "camera b"} <= set(names)
    assert names["trigger"] == "good"
    assert ended.returncode == (5 if "bad" in names.values() else 0)


def test_commands_say_that_the_package_has_lost_its_files(tmp_path: Path) -> None:
    """Removing PyPI's acquire-imaging, which was installed over ours, takes `acquire/__init__.py` along."""
    package, libraries = Path(acquire.__file__).parent, Path(typer.__file__).parents[1]
    shutil.copytree(package, tmp_path / "acquire", ignore=shutil.ignore_patterns("*.pyc"))
    (tmp_path / "acquire" / "__init__.py").unlink()
    # As the installed command; -S: without what this environment adds to the path, such as the checkout.
    command = [sys.executable, "-S", "-c", "import sys; from acquire.cli import main; sys.exit(main())"]
    for word in ("--version", "status", "--help"):
        ended = subprocess.run(
            [*command, word],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
            env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{libraries}"},
        )
        assert ended.returncode == 1
        assert "Traceback" not in ended.stderr
        assert "the installation is incomplete: acquire/__init__.py is missing" in ended.stderr
        assert "pip install --force-reinstall --no-deps tdi-acquire" in ended.stderr
