"""Check the conditions of a release one by one, and list what is left to do.

``python tools/release.py --check`` checks the tree, the version, the changelog, the documents, the rules of
the code, the versions of the libraries, and the packages, which it makes, installs in a fresh environment and
tries. ``--tests`` also runs the whole suite, and ``--all-pythons`` tries every supported Python. Nothing is
tagged and nothing leaves this machine. Ends with 1 if something is left to do.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator, Mapping
from datetime import date
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version

from tools.packages import ROOT, faults, make
from tools.try_pythons import CONSTRAINTS, Tally, claimed, try_all

HEADING = re.compile(r"^## (\S+) \((unreleased|\d{4}-\d\d-\d\d)\)$", re.MULTILINE)
DOCUMENTS = (
    "tests/contract/test_documents.py",
    "-k",
    "links or paths or commands or names_its_test or version",
)
RULES = ("tests/contract/test_habits.py",)
LIMIT_S = 3600


class Undone(Exception):  # noqa: N818 - a thing to do, reported like a result
    """An unmet condition, in words, and what ``todo`` about it."""

    def __init__(self, what: str, todo: str) -> None:
        super().__init__(what)
        self.todo = todo


# ---- the list


def tree_is_clean(root: Path) -> str:
    left = _git(root, "status", "--porcelain").splitlines()
    if left:
        raise Undone(
            f"{len(left)} files differ from the last commit: {left[0][3:]} …", "commit or remove them"
        )
    return f"at {_git(root, 'rev-parse', '--short', 'HEAD')}"


def version_is_new(root: Path) -> str:
    version = version_of(root)
    try:
        Version(version)
    except InvalidVersion:
        raise Undone(f"{version!r} is not a version after PEP 440", "correct __version__") from None
    if f"v{version}" in _git(root, "tag").split():
        raise Undone(f"{version} is released: it has a tag", "raise __version__ in acquire/__init__.py")
    return f"{version}, of which there is no tag"


def changelog_describes_it(root: Path) -> str:
    """The newest section is that of this version, has entries, and a date in the past or (unreleased)."""
    text, version = (root / "CHANGELOG.md").read_text(encoding="utf-8"), version_of(root)
    headings = list(HEADING.finditer(text))
    if text.count("\n## ") != len(headings) or not headings:
        raise Undone("a heading that is not `## VERSION (DATE)`", "write it so, or (unreleased)")
    newest, end = headings[0], headings[1].start() if len(headings) > 1 else len(text)
    if newest[1] != version:
        raise Undone(
            f"its newest section is of {newest[1]}, the program is {version}",
            f"describe the changes of {version}",
        )
    if "\n- " not in text[newest.end() : end]:
        raise Undone(f"the section of {version} has no entry", "describe its changes")
    if newest[2] == "unreleased":
        return f"describes {version}; write the date in place of (unreleased) in the commit that is tagged"
    if _date(newest[2]) > date.today():
        raise Undone(f"{newest[2]} has not come yet", "correct the date")
    return f"describes {version}, {newest[2]}"


def documents_hold(root: Path) -> str:
    """Links, paths and commands exist; every fault names its test; the citation names this version."""
    return _pytest(root, *DOCUMENTS)


def rules_hold(root: Path) -> str:
    """Style, types, layers."""
    return _pytest(root, *RULES)


def constraints_suit(root: Path) -> str:
    """Every requirement has an allowed version in the constraints, which is the one installed here."""
    pins = read_pins(root / CONSTRAINTS.relative_to(ROOT))
    wrong, count = [], 0
    for wanted in requirements(root):
        count += 1
        pin, here = pins.get(canonicalize_name(wanted.name)), _installed(wanted.name)
        if pin is None:
            wrong.append(f"{wanted.name} has no version in {CONSTRAINTS.name}")
        elif not wanted.specifier.contains(pin, prereleases=True):
            wrong.append(f"{wanted.name}=={pin} is not {wanted.specifier}")
        elif here is None:
            wrong.append(f"{wanted.name} {pin} is not installed here")
        elif here != pin:
            wrong.append(f"{wanted.name} {here} is installed here, and not {pin}")
    if wrong:
        raise Undone(
            "; ".join(wrong), "pip install -c tools/constraints.txt -e '.[dev]', or correct the versions"
        )
    return f"{count} libraries are installed in the versions of {CONSTRAINTS.name}"


def packages_are_whole(root: Path) -> str:
    with tempfile.TemporaryDirectory(prefix="acquire-packages-") as home:
        try:
            made = make(Path(home), root)
        except subprocess.CalledProcessError as error:
            raise Undone(_end(error.stdout.decode(errors="replace")), "python -m build") from None
        if wrong := faults(made, root):
            raise Undone("; ".join(wrong), "correct [tool.hatch.build] in pyproject.toml")
        return f"{made.sdist.name} and {made.wheel.name} hold the checkout and nothing else"


def pythons_run(root: Path, programs: list[str]) -> str:
    tally = Tally()
    with tempfile.TemporaryDirectory(prefix="acquire-packages-") as home:
        try_all(programs, tally, make(Path(home), root))
    if tally.failed:
        raise Undone(
            f"failed: {'; '.join(tally.failed)}", "see above; python tools/try_pythons.py tries again"
        )
    return f"installs and runs on {len(programs)} Python{'s' if len(programs) > 1 else ''}"


def tests_pass(root: Path) -> str:
    return _pytest(root, "tests")


# ---- facts


def version_of(root: Path) -> str:
    """Version as written in the file, whatever is imported."""
    found = re.search(
        r'^__version__ = "(.+)"$', (root / "acquire/__init__.py").read_text("utf-8"), re.MULTILINE
    )
    if found is None:
        raise Undone("acquire/__init__.py has no __version__", 'write __version__ = "…"')
    return found[1]


def read_pins(path: Path) -> dict[str, str]:
    """Library → its version."""
    lines = (line.partition("#")[0].strip() for line in path.read_text(encoding="utf-8").splitlines())
    return {canonicalize_name(name): pin for name, _, pin in (line.partition("==") for line in lines) if pin}


def requirements(root: Path) -> Iterator[Requirement]:
    """Requirements of the core and of the extra `dev`, with the extras that it names, for this machine."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    waiting, seen = [*project["dependencies"], *project["optional-dependencies"]["dev"]], set[str]()
    while waiting:
        one = Requirement(waiting.pop())
        if one.marker is not None and not one.marker.evaluate():
            continue
        if one.name == project["name"]:
            waiting += [
                text for extra in one.extras - seen for text in project["optional-dependencies"][extra]
            ]
            seen |= one.extras
        else:
            yield one


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _date(text: str) -> date:
    try:
        return date.fromisoformat(text)
    except ValueError:
        raise Undone(f"{text} is no date", "write it as 2026-11-22") from None


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, timeout=60, check=False)
    if done.returncode:
        raise Undone(f"git {words[0]}: {_end(done.stderr)}", "release from a checkout")
    return done.stdout.rstrip()


def _pytest(root: Path, *words: str) -> str:
    command = [
        sys.executable,
        "-m",
        "pytest",
        "--durations=0",
        "-n",
        "auto" if words == ("tests",) else "0",
        *words,
    ]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    last = _end(done.stdout or done.stderr)
    if done.returncode:
        failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        raise Undone("\n".join(failed) or last, f"python -m pytest {' '.join(words)}")
    return last


def _end(text: str) -> str:
    return (text.strip().splitlines() or ["it printed nothing"])[-1].strip("= ")


# ---- the command

Item = Callable[[Path], str]


def check(items: Mapping[str, Item], root: Path) -> int:
    """Print which conditions are met; return the number that are not."""
    undone = 0
    for name, item in items.items():
        try:
            print(f"✓ {name}: {item(root)}", flush=True)
        except Undone as found:
            undone += 1
            print(f"✗ {name}: {found}\n    to do: {found.todo}", flush=True)
    return undone


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", required=True, help="check, and change nothing")
    parser.add_argument("--tests", action="store_true", help="also run the whole suite")
    parser.add_argument("--all-pythons", action="store_true", help="try every supported Python")
    options = parser.parse_args()
    programs = claimed() if options.all_pythons else [sys.executable]
    items: dict[str, Item] = {
        "tree": tree_is_clean,
        "version": version_is_new,
        "changelog": changelog_describes_it,
        "documents": documents_hold,
        "rules": rules_hold,
        "libraries": constraints_suit,
        "packages": packages_are_whole,
        "pythons": lambda root: pythons_run(root, programs),
    }
    if options.tests:
        items["tests"] = tests_pass
    undone = check(items, ROOT)
    left = [] if options.tests else ["the whole suite (--tests)"]
    left += [] if options.all_pythons else ["the other Pythons (--all-pythons)"]
    if left:
        print(f"– not checked: {', '.join(left)}")
    version = version_of(ROOT)
    print(
        f"{undone} to do"
        if undone
        else f"ready: git tag v{version}, then python tools/packages.py --out dist"
    )
    return 1 if undone else 0


if __name__ == "__main__":
    sys.exit(main())
