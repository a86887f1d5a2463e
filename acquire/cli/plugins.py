"""``acquire plugins``: list the installed plug-ins, the packages they come from, and their errors."""

from __future__ import annotations

import re

import typer

from acquire.cli.output import JsonFlag, print_json, print_table, say
from acquire.cli.usage import not_installed

# In Python's own words: of a plug-in that failed, only the text of its error is kept.
_MISSING = re.compile(r"No module named '([^.']+)")
COLUMNS = ("kind", "name", "distribution", "version", "state")


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Rig")(plugins)


def plugins(json: JsonFlag = False) -> None:
    """List every effect, scene, driver, codec, solver and denoiser, with its package and whether it works.

    Packages installed in the same environment can add plug-ins (PLUGINS.md). A plug-in that cannot be
    imported is listed here with its error and left out everywhere else.

    Example: [bold]acquire plugins[/]
    """
    from acquire.plugins import GROUPS, OURS, described, unknown_groups

    rows = []
    for group in GROUPS:
        for plugin in group.found():
            error = why = group.trouble(plugin)
            # One of our own plug-ins that lacks a package can name the extra that installs it.
            if plugin.distribution == OURS and (missing := _MISSING.search(error)):
                lacking = not_installed(ModuleNotFoundError(name=missing[1]))
                why = f"{missing[1]} is not installed; try: {lacking.hint}"
            rows.append(
                {
                    "kind": group.what,
                    "group": group.name,
                    "name": plugin.name,
                    "distribution": plugin.distribution,
                    "version": plugin.version,
                    "works": not error,
                    "error": why,
                    "about": "" if error else described(group.load(plugin.name)),
                }
            )
    if json:
        print_json(rows)
        return
    shown = [row | {"state": "broken" if row["error"] else "ok"} for row in rows]
    print_table(COLUMNS, [[row[column] for column in COLUMNS] for row in shown])
    # Below the table, which long errors would make too wide for a terminal.
    for row in rows:
        if row["error"]:
            say(f"{row['kind']} {row['name']} of {row['distribution']} {row['version']}: {row['error']}")
    for unknown, distributions in unknown_groups().items():
        possible = ", ".join(each.name for each in GROUPS)
        say(f"{', '.join(distributions)}: there is no group {unknown}; possible: {possible}")
