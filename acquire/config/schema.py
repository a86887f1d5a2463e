"""JSON schemas for editors: of a model, and of every installed class that it has a place for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.config.variants import GROUP_KEY
from acquire.plugins import GROUPS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pydantic import BaseModel

_GROUPS = {group.name: group for group in GROUPS}


def whole_schema(model: type[BaseModel]) -> dict[str, Any]:
    """The JSON schema of a model, with the classes of every group that it has a place for.

    A table with a ``kind`` is one of the group's classes; ``options`` are what the ``driver`` beside them
    says. What cannot be imported is left out.
    """
    schema = model.model_json_schema()
    definitions = schema.setdefault("$defs", {})
    waiting, defined = list(_filled(schema)), set[str]()
    while waiting:
        name = waiting.pop()
        if name in defined:
            continue
        defined.add(name)
        if any("kind" in choice.model_fields for choice in _GROUPS[name].working().values()):
            definitions[name] = _one_of(name)
        for kind, choice in _GROUPS[name].working().items():
            one = choice.model_json_schema(ref_template=f"#/$defs/{name}.{kind}.{{model}}")
            below = one.pop("$defs", {})
            definitions[f"{name}.{kind}"] = one
            definitions.update({f"{name}.{kind}.{key}": value for key, value in below.items()})
            waiting += _filled([one, below])
    return schema


def _one_of(name: str) -> dict[str, Any]:
    mapping = {kind: f"#/$defs/{name}.{kind}" for kind in _GROUPS[name].working()}
    choices = [{"$ref": ref} for ref in mapping.values()]
    return {"oneOf": choices, "discriminator": {"propertyName": "kind", "mapping": mapping}}


def _filled(node: Any) -> Iterator[str]:
    """Replace every mark by what stands for it; the names of the groups that are then to be defined."""
    if isinstance(node, list):
        for value in node:
            yield from _filled(value)
    if not isinstance(node, dict):
        return
    options = node.get("properties", {}).get("options", {})
    if GROUP_KEY in options:
        name = options.pop(GROUP_KEY)
        options.pop("default", None)  # the driver's own
        node["allOf"] = [_where(driver, f"#/$defs/{name}.{driver}") for driver in _GROUPS[name].working()]
        yield name
    if GROUP_KEY in node:
        name = node.pop(GROUP_KEY)
        del node["type"]
        node["$ref"] = f"#/$defs/{name}"
        yield name
    for value in list(node.values()):
        yield from _filled(value)


def _where(driver: str, ref: str) -> dict[str, Any]:
    """Options of one driver; a table that names none is of the default one, which an editor need not know."""
    named = {"properties": {"driver": {"const": driver}}, "required": ["driver"]}
    return {"if": named, "then": {"properties": {"options": {"$ref": ref}}}}
