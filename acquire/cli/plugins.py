"""``acquire plugins``: list the installed plug-ins, the packages they come from, and their errors."""

from __future__ import annotations

import re
from typing import Any

import typer

from acquire.cli.output import JsonFlag, print_json, print_table, say
from acquire.cli.usage import not_installed

_MISSING = re.compile(r"No module named '([^.']+)")
COLUMNS = ("kind", "name", "distribution", "version", "state")


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Rig")(plugins)


def plugins(json: JsonFlag = False) -> None:
    """List every effect, scene, driver, solver and denoiser, with its package and whether it works.

    Packages installed in the same environment can add plug-ins (PLUGINS.md). A plug-in that cannot be
    imported is listed here with its error and left out everywhere else.

    Example: [bold]acquire plugins[/]
    """
    rows = _rows()
    if json:
        print_json(rows)
        return
    shown = [row | {"state": "broken" if row["error"] else "ok"} for row in rows]
    print_table(COLUMNS, [[row[column] for column in COLUMNS] for row in shown])
    for row in rows:
        if row["error"]:
            say(f"{row['kind']} {row['name']} of {row['distribution']} {row['version']}: {row['error']}")


def _rows() -> list[dict[str, Any]]:
    from acquire.plugins import GROUPS, described

    rows = []
    for group in GROUPS:
        for plugin in group.found():
            error = group.trouble(plugin)
            rows.append(
                {
                    "kind": group.what,
                    "group": group.name,
                    "name": plugin.name,
                    "distribution": plugin.distribution,
                    "version": plugin.version,
                    "works": not error,
                    "error": _with_extra(error, plugin.distribution),
                    "about": "" if error else described(group.load(plugin.name)),
                }
            )
    return rows


def _with_extra(error: str, distribution: str) -> str:
    """Name the extra to install if one of our own plug-ins lacks a package."""
    from acquire.plugins import OURS

    missing = _MISSING.search(error) if distribution == OURS else None
    if missing is None:
        return error
    lacking = not_installed(ModuleNotFoundError(name=missing[1]))
    return f"{missing[1]} is not installed; try: {lacking.hint}"
