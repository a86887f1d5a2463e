"""Error messages for configuration files: pydantic's findings in terms of the file's own keys."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.config.variants import GROUP_KEY
from acquire.plugins import GROUPS
from acquire.text import counted, own_words, shortened, shown

if TYPE_CHECKING:
    from pathlib import Path

    from pydantic import BaseModel, ValidationError

_GROUPS = {group.name: group for group in GROUPS}
_CONTAINERS = {"tuple_type": "tuple", "list_type": "list", "set_type": "set", "frozen_set_type": "frozenset"}
MOST_LISTED = 20
"""Largest number of findings that one error lists."""


def explained(error: ValidationError, model: type[BaseModel], path: Path | str) -> str:
    """Return one line per finding, with its key, its value, the reason and what is allowed."""
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
    lines = [f"{path}: {counted(len(findings), 'error')}"]
    for item in findings[:MOST_LISTED]:
        keys, allowed, secret = _locate(model, item["loc"])
        key = shortened(".".join(keys)) or "(file)"
        why = _why(item)
        # pydantic's own sentence, "Extra inputs are not permitted", does not name the keys that are.
        if item["type"] == "extra_forbidden":
            lines.append(f"  {key}: unknown key; allowed here: {', '.join(allowed) or 'none'}")
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


def _why(item: Any) -> str:
    """Return the reason of a finding; pydantic's own for a wrong container names a class that no file has."""
    kind, value = item["type"], item["input"]
    if kind in _CONTAINERS and not isinstance(value, tuple):
        return "a list is expected"
    if kind in _CONTAINERS:
        return (
            f"the plug-in asks for a {_CONTAINERS[kind]}, which no file can hold; its field should be a tuple"
        )
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
