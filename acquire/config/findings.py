"""Error messages for configuration files: pydantic's findings in terms of the file's own keys."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.config.variants import GROUP_KEY
from acquire.plugins import GROUPS
from acquire.text import counted, did_you_mean, own_words, shortened, shown

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from pydantic import BaseModel, ValidationError

_GROUPS = {group.name: group for group in GROUPS}
_CONTAINERS = {"tuple_type": "tuple", "list_type": "list", "set_type": "set", "frozen_set_type": "frozenset"}
MOST_LISTED = 20
"""Largest number of findings that one error lists."""


def explained(
    error: ValidationError,
    model: type[BaseModel],
    path: Path | str,
    options: Mapping[str, str] | None = None,
) -> str:
    """Return one line per finding, with its key, its value, the reason and what is allowed.

    ``options`` holds the dotted keys that are not from the file → what gives them, such as ``--set``.
    """
    options = options or {}
    found: list[Any] = list(error.errors())
    places = [item["loc"] for item in found]
    # Without lists that are too short only because pydantic did not count their invalid items.
    findings = [
        item
        for item in found
        if item["type"] != "too_short"
        or not any(
            len(place) > len(item["loc"]) and place[: len(item["loc"])] == item["loc"] for place in places
        )
    ]
    others = " and ".join(dict.fromkeys(options.values()))
    lines = [f"{path}{f' with {others}' if others else ''}: {counted(len(findings), 'error')}"]
    for item in findings[:MOST_LISTED]:
        keys, allowed, secret = _locate(model, item["loc"])
        key = _given_by(keys, options) + (shortened(".".join(keys)) or "(file)")
        why = _why(item)
        # pydantic's own sentence, "Extra inputs are not permitted", does not name the keys that are.
        if item["type"] == "extra_forbidden":
            meant, possible = _meant(keys[-1], allowed, model), ", ".join(allowed) or "none"
            lines.append(f"  {key}: unknown key{meant}; allowed here: {possible}")
        elif item["type"] == "missing":
            lines.append(f"  {key}: missing")
        # A whole table would be longer than the reason, and a secret would be in the daemon's log.
        elif secret or isinstance(item["input"], dict):
            lines.append(f"  {key}: {why}")
        else:
            value = item["input"]
            # As it is in the file: the models turn lists into tuples.
            lines.append(f"  {key} = {shown(list(value) if isinstance(value, tuple) else value)}: {why}")
    if len(findings) > MOST_LISTED:
        lines.append(f"  and {len(findings) - MOST_LISTED} more")
    return "\n".join(lines)


def _given_by(keys: list[str], options: Mapping[str, str]) -> str:
    """Return what gives the key, or a key below it, if that is not the file."""
    for dotted, option in options.items():
        given = dotted.split(".")
        common = min(len(given), len(keys))
        if common and given[:common] == keys[:common]:
            return f"{option} "
    return ""


def _meant(key: str, allowed: list[str], model: type[BaseModel]) -> str:
    """Return a guess at the key that was meant: one next to it, or the dotted key in another table."""
    schema = model.model_json_schema()
    elsewhere = dict(reversed([(name.rpartition(".")[2], name) for name in _dotted(schema, schema, 4)]))
    # Of another table only the very same name: 'seed' is not 'simulation.speed'.
    return f"; did you mean {elsewhere[key]!r}?" if key in elsewhere else did_you_mean(key, allowed)


def _dotted(schema: dict[str, Any], node: dict[str, Any], depth: int) -> Iterator[str]:
    """Yield the dotted keys of a schema, as deep as files are."""
    if "$ref" in node:
        node = schema["$defs"][node["$ref"].rsplit("/", 1)[1]]
    for key, below in node.get("properties", {}).items():
        yield key
        if depth:
            yield from (f"{key}.{name}" for name in _dotted(schema, below, depth - 1))


def _why(item: Any) -> str:
    """Return the reason of a finding; pydantic's own for a wrong container names a class that no file has."""
    kind, value = item["type"], item["input"]
    if kind in _CONTAINERS and not isinstance(value, tuple):
        return "a list is expected"
    if kind in _CONTAINERS:
        return (
            f"the plug-in asks for a {_CONTAINERS[kind]}, which no file can hold; its field should be a tuple"
        )
    if kind in ("model_type", "model_attributes_type"):
        return "a table is expected"
    if kind == "is_instance_of":
        wanted = str(item["ctx"]["class"])
        instead = "acquire.config.base.FilePath" if wanted == "Path" else "of a type that TOML has"
        return f"the plug-in asks for a {wanted}, which no file can hold; its field should be {instead}"
    return shortened(own_words(item["msg"]), 400)


def _locate(model: type[BaseModel], location: tuple[int | str, ...]) -> tuple[list[str], list[str], bool]:
    """Return the key as it is in the file, the keys allowed next to it, and whether its value is a secret.

    pydantic's location also contains the tags of unions and groups, which are not in the file. The schema
    distinguishes them from keys.
    """
    schema = model.model_json_schema()
    node: dict[str, Any] = schema
    keys: list[str] = []
    allowed: list[str] = []
    secret = False
    for part in location:
        while "$ref" in node:
            node = schema["$defs"][node["$ref"].rsplit("/", 1)[1]]
        if GROUP_KEY in node:
            # This part of the location is the plug-in's name; the keys after it are those of its own model.
            schema = node = _GROUPS[node[GROUP_KEY]].load(str(part)).model_json_schema()
            continue
        if "mapping" in node.get("discriminator", {}) and part in node["discriminator"]["mapping"]:
            node = {"$ref": node["discriminator"]["mapping"][part]}
            continue
        keys.append(str(part))
        allowed = sorted(node.get("properties", {}))
        node = node.get("items", {}) if isinstance(part, int) else node.get("properties", {}).get(part, {})
        secret = secret or bool(node.get("writeOnly"))
    return keys, allowed, secret
