"""``acquire config list | check | show | schema``: work with configurations, without opening devices."""

from __future__ import annotations

import re
from itertools import takewhile
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from acquire.cli.completion import configurations
from acquire.cli.output import JsonFlag, json_text, print_facts, print_json, quantity, say

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pydantic import BaseModel

    from acquire.config import RigConfig

FileArgument = Annotated[
    str,
    typer.Argument(
        metavar="FILE", autocompletion=configurations, help="Rig file, or the name of a built-in rig."
    ),
]

USED_BY = {
    "rig": "serve, arm and all commands with --config",
    "scene": "simulate, and a rig's simulated cameras",
    "plan": "reconstruct --plan",
}
"""Kind of configuration → the commands that take it."""


def register(app: typer.Typer) -> None:
    group = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")
    group.command("list")(list_configurations)
    for command in (check, show, schema):
        group.command()(command)
    app.add_typer(
        group,
        name="config",
        help="List, check and show configurations: rigs, scenes and plans.",
        rich_help_panel="Rig",
    )


def list_configurations(
    kind: Annotated[
        Literal["rig", "scene", "plan"] | None,
        typer.Argument(metavar="KIND", help="Kind of configuration: rig, scene or plan. Default: all kinds."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """List the built-in configurations by kind: rigs, scenes and plans.

    Example: [bold]acquire config list scene[/]
    """
    from acquire.place import builtin_names

    kinds = USED_BY if kind is None else {kind: USED_BY[kind]}
    found = [
        {"kind": each, "name": name, "about": _about(name)}
        for each in kinds
        for name in builtin_names(f"{each}-")
    ]
    if json:
        print_json(found)
        return
    for number, (each, command) in enumerate(kinds.items()):
        if number:
            say()
        say(f"{each}s, for {command}:")
        print_facts({f"  {one['name']}": one["about"] for one in found if one["kind"] == each})


def _about(name: str) -> str:
    """Return the first sentence of a file's leading comment; its title or name if there is none."""
    import tomllib

    from acquire.place import builtin_directory

    text = (builtin_directory() / f"{name}.toml").read_text(encoding="utf-8")
    comment = " ".join(
        line.lstrip("# ") for line in takewhile(lambda line: line.startswith("#"), text.splitlines())
    )
    table = tomllib.loads(text)
    # "Fig. 8" does not end a sentence.
    sentence = re.split(r"(?<!Fig)[.;](?:\s|$)", comment, maxsplit=1)[0]
    return sentence or str(table.get("title") or table.get("name", ""))


def check(file: FileArgument, json: JsonFlag = False) -> None:
    """Validate a rig file, its scene and its recording directory, and print a summary.

    Example: [bold]acquire config check rig-demo[/]
    """
    from acquire.config import load_rig, load_scene
    from acquire.daemon.endpoint import check_path
    from acquire.daemon.host import check_host
    from acquire.daemon.uploads import check_upload
    from acquire.place import default_socket
    from acquire.rig import check_rig
    from acquire.web.certificate import tls_context

    rig = load_rig(file)
    check_rig(rig)
    if rig.needs_scene:
        load_scene(rig.scene_file())
    # As `serve` does: what would fail there is refused here, with the rig file at hand.
    check_host(rig)
    check_upload(rig)
    # The default socket may be replaced by `serve --socket`, and its directory is made when it is needed.
    if rig.control.socket != default_socket():
        check_path(rig.control.socket)
    if rig.web is not None:
        tls_context(rig.web)
    facts = _facts(rig)
    if json:
        print_json({"file": file, "valid": True, **facts})
        return
    say(f"{file}: valid")
    print_facts(
        {
            "rig": facts["name"],
            "geometry": f"M = {facts['stages']} stages, S = {facts['substeps']} sub-steps, "
            f"n = {facts['size']} rows and columns",
            "scene": facts["behind_fibre"],
            "lines": quantity(facts["line_rate_hz"], "Hz"),
            "sub-steps": quantity(facts["substep_rate_hz"], "Hz"),
            "data": f"{quantity(facts['bytes_per_s'], 'B')}/s from both arms, {facts['dtype']}",
            "uploads to": facts["upload_to"],
            "socket": facts["socket"],
        }
    )


def show(file: FileArgument, json: JsonFlag = False) -> None:
    """Print the whole configuration with all defaults filled in, as TOML that can be used as a rig file.

    Example: [bold]acquire config show rig-demo[/]
    """
    from acquire.config import load_rig
    from acquire.config.service import WHOLE

    table = load_rig(file).model_dump(mode="json", context=WHOLE)
    if json:
        print_json(table)
        return
    for line in dotted(table):
        say(line)


def schema(
    of: Annotated[
        Literal["rig", "scene", "plan"],
        typer.Option("--of", help="Kind of file to describe: rig, scene or plan."),
    ] = "rig",
) -> None:
    """Print the JSON schema of rig, scene or plan files for editors: every key, its limits and default.

    The schema covers everything that is installed now, including plug-ins.

    Example: [bold]acquire config schema > rig.schema.json[/]
    """
    from acquire.config import RigConfig
    from acquire.config.plan import ReconstructionPlan
    from acquire.config.scene import SceneFile
    from acquire.config.schema import whole_schema

    models: dict[str, type[BaseModel]] = {"rig": RigConfig, "scene": SceneFile, "plan": ReconstructionPlan}
    print_json(whole_schema(models[of]))


def _facts(rig: RigConfig) -> dict[str, Any]:
    stages, substeps, fibre = rig.geometry.stages, rig.geometry.substeps, rig.laid_out
    tiles = None
    if fibre is not None:
        tiles = (
            f"{fibre.rows} x {fibre.columns} behind a fibre: {fibre.tile_rows} x {fibre.tile_columns} tiles"
        )
    sample_bytes = 1 if rig.cameras.a.dtype == "uint8" else 2
    return {
        "name": rig.name,
        "stages": stages,
        "substeps": substeps,
        "size": stages * substeps,
        "line_rate_hz": rig.line_rate_hz,
        "substep_rate_hz": rig.line_rate_hz * substeps,
        "dtype": rig.cameras.a.dtype,
        "behind_fibre": tiles,
        "pixels": rig.pixels,
        "bytes_per_s": 2 * rig.line_rate_hz * rig.pixels * sample_bytes,
        "upload_to": rig.recording.upload_to,
        "socket": str(rig.control.socket),
    }


def dotted(table: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield ``a.b = value`` for every leaf of a table.

    Numbers, texts, booleans and lists are written the same in JSON and TOML; a key with the value null is
    left out.
    """
    for key, value in table.items():
        if isinstance(value, dict):
            yield from dotted(value, f"{prefix}{key}.")
        # TOML has no null.
        elif value is not None:
            # Unprintable characters are \uXXXX in both.
            yield f"{prefix}{key} = {json_text(value)}"
