"""The checks before a release see what is not so, and say what to do."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packed import install

import acquire
from tools import release, try_pythons
from tools.packages import ROOT
from tools.smoke import CORE, try_out
from tools.try_pythons import CONSTRAINTS, Tally, TrialError, ask, claimed, try_all


def checkout(home: Path, changelog: str, version: str = "1.2.0") -> Path:
    """All that the checks of tree, version and changelog look at, committed."""
    (home / "acquire").mkdir()
    (home / "acquire/__init__.py").write_text(f'"""Here."""\n__version__ = "{version}"\n')
    (home / "CHANGELOG.md").write_text(f"# Changelog\n\n{changelog}")
    git(home, "init", "-q")
    git(home, "add", "-A")
    git(home, "-c", "user.name=n", "-c", "user.email=e", "commit", "-qm", "all")
    return home


def git(home: Path, *words: str) -> None:
    subprocess.run(["git", *words], cwd=home, check=True, timeout=60)


@pytest.mark.needs_git
def test_a_tree_and_a_version_are_ready_once(tmp_path: Path) -> None:
    root = checkout(tmp_path, "## 1.2.0 (unreleased)\n\n- **It** works.\n")
    assert release.tree_is_clean(root).startswith("at ")
    assert release.version_is_new(root) == "1.2.0, of which there is no tag"
    assert "write the date" in release.changelog_describes_it(root)
    git(root, "tag", "v1.2.0")
    (root / "left.txt").touch()
    with pytest.raises(release.Undone, match=r"is released: it has a tag"):
        release.version_is_new(root)
    with pytest.raises(release.Undone, match=r"1 files differ from the last commit: left\.txt"):
        release.tree_is_clean(root)
    items = {"tree": release.tree_is_clean, "changelog": release.changelog_describes_it}
    assert release.check(items, root) == 1


@pytest.mark.parametrize(
    ("changelog", "said"),
    [
        ("## 1.2.0 (2026-01-31)\n\n- **It** works.\n", None),
        ("## 1.1.0 (2026-01-31)\n\n- **It** works.\n", "newest section is of 1.1.0, the program is 1.2.0"),
        ("## 1.2.0 (unreleased)\n\n## 1.1.0 (2025-01-31)\n\n- **It** works.\n", "has no entry"),
        ("## 1.2.0 (2999-01-31)\n\n- **It** works.\n", "has not come yet"),
        ("## 1.2.0 (2026-02-30)\n\n- **It** works.\n", "is no date"),
        ("## 1.2.0\n\n- **It** works.\n", "a heading that is not"),
    ],
)
def test_the_changelog_describes_this_version(tmp_path: Path, changelog: str, said: str | None) -> None:
    root = checkout(tmp_path, changelog)
    if said is None:
        assert release.changelog_describes_it(root) == "describes 1.2.0, 2026-01-31"
        return
    with pytest.raises(release.Undone, match=said):
        release.changelog_describes_it(root)


def test_every_library_that_is_asked_for_has_a_version_that_is_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is installed here is the machine's affair, and taken as it should be."""
    pins = release.read_pins(CONSTRAINTS)
    monkeypatch.setattr(release, "_installed", lambda name: pins.get(canonicalize_name(name)))
    assert "libraries are installed" in release.constraints_suit(ROOT)
    names = {one.name for one in release.requirements(ROOT)}
    assert {"numpy", "build", "numba", "tifffile", "moto"} <= names
    assert "tdi-acquire" not in names
    monkeypatch.setattr(
        release, "requirements", lambda _: [Requirement("numpy<2"), Requirement("nothing>=1")]
    )
    with pytest.raises(release.Undone, match=r"numpy==2\S+ is not <2; nothing has no version"):
        release.constraints_suit(ROOT)


def test_a_python_that_is_not_there_or_does_not_run_is_named(tmp_path: Path) -> None:
    broken = tmp_path / "python3.12"
    broken.write_text("#!/bin/sh\necho 'python3.12: command not found' >&2\nexit 127\n")
    broken.chmod(0o755)
    with pytest.raises(TrialError, match="command not found; name one with --python"):
        ask(str(broken))
    with pytest.raises(TrialError, match=r"not found \(No such file"):
        ask(str(tmp_path / "python9.9"))
    assert ask(sys.executable).version.startswith("3.")
    assert claimed() == ["python3.11", "python3.12", "python3.13"]


def test_the_smoke_test_tells_what_a_command_said(tmp_path: Path) -> None:
    program = tmp_path / "acquire"
    program.write_text(
        '#!/bin/sh\n[ "$1" = --version ] && echo 9 && exit\necho "no cameras here" >&2\nexit 5\n'
    )
    program.chmod(0o755)
    steps = CORE
    told = {name: (said, good) for name, said, good in try_out(program, steps)}
    assert told == {"version": ("9", True), "capture": ("ended with 5: no cameras here", False)}
    here = Path(sys.executable).with_name("acquire")
    assert [*try_out(here, {"version": steps["version"]})] == [("version", acquire.__version__, True)]


def test_what_fails_on_one_python_does_not_keep_another_from_being_tried(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tried: list[str] = []
    monkeypatch.setattr(try_pythons, "faults", lambda made: ["the wheel lacks a wing"])
    monkeypatch.setattr(try_pythons, "try_python", lambda python, made, tally: tried.append(python.program))
    tally = Tally()
    try_all(["no-such-python", sys.executable], tally, made=None)  # type: ignore[arg-type]
    assert tally.failed == ["packages", "no-such-python"]
    assert tried == [sys.executable]
    assert "✗ packages: the wheel lacks a wing" in capsys.readouterr().out


def test_constraints_that_do_not_suit_a_python_are_said_and_done_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the pip of here, which installs aside and asks no index."""
    install(ROOT / "tests/plugins/lab_extras", tmp_path / "first", tmp_path / "wheels")
    (wheel,) = (tmp_path / "wheels").glob("*.whl")
    (tmp_path / "env/bin").mkdir(parents=True)
    python = tmp_path / "env/bin/python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    constraints = tmp_path / "constraints.txt"
    constraints.write_text("lab-extras==99\n")
    monkeypatch.setattr(try_pythons, "CONSTRAINTS", constraints)
    tally, options = Tally(), ("--no-index", "--no-deps", "--no-compile", "--target", str(tmp_path / "site"))
    try_pythons.install("lab", tmp_path / "env", str(wheel), tally, *options)
    assert "✓ lab: without the constraints, which do not suit it: ERROR: " in capsys.readouterr().out
    assert (tmp_path / "site/lab_extras.py").exists()
    with pytest.raises(TrialError, match=r"with the constraints and without: ended with 1\n.*"):
        try_pythons.install("lab", tmp_path / "env", str(tmp_path / "none.whl"), tally, *options)
