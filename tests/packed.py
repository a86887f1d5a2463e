"""Distributions of others, packed from their folders and installed by pip, offline."""

from __future__ import annotations

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path


def install(folder: Path, target: Path, wheels: Path) -> None:
    """The distribution of a folder (pyproject.toml and its modules) into ``target``, as ``pip install`` does.

    The wheel holds what hatchling would pack: a build backend is not among what the tests install.
    """
    document = tomllib.loads((folder / "pyproject.toml").read_text())
    project = document["project"]
    name = project["name"].replace("-", "_")
    about = f"{name}-{project['version']}.dist-info"
    groups = "".join(
        f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in entries.items())
        for group, entries in project["entry-points"].items()
    )
    files = {
        **{
            file: (folder / file).read_text()
            for file in document["tool"]["hatch"]["build"]["targets"]["wheel"]["only-include"]
        },
        f"{about}/METADATA": f"Metadata-Version: 2.1\nName: {project['name']}\n"
        f"Version: {project['version']}\n",
        f"{about}/WHEEL": "Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{about}/entry_points.txt": groups,
    }
    record = "".join(f"{path},,\n" for path in (*files, f"{about}/RECORD"))
    wheels.mkdir(exist_ok=True)
    wheel = wheels / f"{name}-{project['version']}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as packed:
        for path, text in (files | {f"{about}/RECORD": record}).items():
            packed.writestr(path, text)
    options = ("--no-deps", "--no-index", "--no-compile", "--quiet", "--disable-pip-version-check")
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, "--target", str(target), str(wheel)],
        check=True,
        timeout=300,
    )
