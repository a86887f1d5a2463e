"""``acquire plugins``: the variants that are installed, whose they are, and what is wrong with them."""

from __future__ import annotations

import re
from typing import Any

import typer

from acquire.cli.output import JsonFlag, print_json, print_table
from acquire.cli.usage import not_installed

_MISSING = re.compile(r"No module named '([^.']+)")
COLUMNS = ("kind", "name", "distribution", "version", "state")


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Rig")(plugins)


def plugins(json: JsonFlag = False) -> None:
    """List every effect, scene, driver, solver and denoiser: its name, who brings it, and whether it works.

    Whatever is installed in the same environment can add some (PLUGINS.md). One that cannot be imported is
    named here with its error and left out everywhere else.

    Example: [bold]acquire plugins[/]
    """
    rows = _rows()
    if json:
        print_json(rows)
        return
    print_table(COLUMNS, [[row[column] for column in COLUMNS] for row in rows])


def _rows() -> list[dict[str, Any]]:
    from acquire.plugins import GROUPS, OURS, described

    rows = []
    for group in GROUPS:
        for plugin in group.found():
            trouble = group.trouble(plugin)
            if plugin.distribution == OURS and (missing := _MISSING.search(trouble)):
                trouble = not_installed(
                    ModuleNotFoundError(name=missing[1])
                ).hint  # an extra that is not here
            rows.append(
                {
                    "kind": group.what,
                    "group": group.name,
                    "name": plugin.name,
                    "distribution": plugin.distribution,
                    "version": plugin.version,
                    "works": not trouble,
                    "state": trouble or "ok",
                    "about": "" if trouble else described(group.load(plugin.name)),
                }
            )
    return rows
