"""Wheel and source distribution hold what they should, and say who they are."""

from __future__ import annotations

import re
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest

import acquire
from tools.install_size import installed
from tools.packages import ROOT, Packages, faults, files_of_sdist, make


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Packages:
    return make(tmp_path_factory.mktemp("dist"))


@pytest.mark.needs_git
def test_packages_hold_the_checkout_and_nothing_else(made: Packages) -> None:
    assert faults(made) == []
    assert {"tests/conftest.py", "tools/constraints.txt", ".ci/run"} <= files_of_sdist(made.sdist)


@pytest.mark.needs_git
def test_what_is_wrong_with_packages_is_named(made: Packages, tmp_path: Path) -> None:
    wheel = tmp_path / made.wheel.name
    with zipfile.ZipFile(made.wheel) as old, zipfile.ZipFile(wheel, "w") as new:
        for name in old.namelist():
            if name != "acquire/configs/rig-demo.toml":
                new.writestr(name, old.read(name))
        new.writestr("acquire/notes.txt", "left here")
    told = "\n".join(faults(Packages(made.sdist, wheel, made.wheel_of_checkout)))
    assert "the wheel lacks acquire/configs/rig-demo.toml" in told
    assert "the wheel has, and the program does not acquire/notes.txt" in told
    assert "differ in acquire/configs/rig-demo.toml, acquire/notes.txt" in told


def test_the_version_is_written_in_one_place(made: Packages) -> None:
    with zipfile.ZipFile(made.wheel) as wheel:
        (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
        facts = message_from_bytes(wheel.read(name))
    assert facts["Version"] == acquire.__version__
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert "version" not in project
    assert f"tdi_acquire-{acquire.__version__}.tar.gz" == made.sdist.name
    pythons = re.findall(r"Python :: (3\.\d+)$", "\n".join(facts.get_all("Classifier", [])), re.MULTILINE)
    assert pythons == ["3.11", "3.12", "3.13"]
    assert facts["Requires-Python"] == f">={pythons[0]}"


def test_a_capture_host_installs_no_more_than_it_needs() -> None:
    """At most 170 MiB, of which numpy and numcodecs are 103; see tools/MEASURED.md for what `du` shows."""
    sizes = installed()
    assert sum(size.total for size in sizes.values()) / 2**20 < 170, sizes
    assert not {"scipy", "numba", "matplotlib", "llvmlite", "pillow", "jinja2"} & set(sizes)
    # What every capture host has: the list names what is really followed.
    assert {"tdi-acquire", "numpy", "zarr", "numcodecs", "fastapi", "typer", "fastcrc"} <= set(sizes)
