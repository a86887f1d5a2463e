"""JSON schemas for editors, of a model and of every installed class that its tables may use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.config.variants import GROUP_KEY, NAMED_BY_KEY
from acquire.plugins import GROUPS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pydantic import BaseModel

_GROUPS = {group.name: group for group in GROUPS}


def whole_schema(model: type[BaseModel]) -> dict[str, Any]:
    """Return the JSON schema of a model, including the classes of every group that its tables may use.

    A table with a ``kind`` is one of the group's classes; options are those of the class that the key next
    to them names. Classes that cannot be imported are left out.
    """
    schema = model.model_json_schema()
    definitions = schema.setdefault("$defs", {})
    waiting, defined = list(_resolve_marks(schema)), set[str]()
    while waiting:
        name = waiting.pop()
        if name in defined:
            continue
        defined.add(name)
        classes = _GROUPS[name].working()
        if any("kind" in each.model_fields for each in classes.values()):
            mapping = {kind: f"#/$defs/{name}.{kind}" for kind in classes}
            definitions[name] = {
                "oneOf": [{"$ref": ref} for ref in mapping.values()],
                "discriminator": {"propertyName": "kind", "mapping": mapping},
            }
        for kind, each in classes.items():
            definition = each.model_json_schema(ref_template=f"#/$defs/{name}.{kind}.{{model}}")
            nested = definition.pop("$defs", {})
            definitions[f"{name}.{kind}"] = definition
            definitions.update({f"{name}.{kind}.{key}": value for key, value in nested.items()})
            # A class may use other groups, or its own: the parts of a sum of scenes are scenes.
            waiting += _resolve_marks([definition, nested])
    return schema


def _resolve_marks(node: Any) -> Iterator[str]:
    """Replace every group's mark by references; yield the names of the groups, which must then be defined."""
    if isinstance(node, list):
        for value in node:
            yield from _resolve_marks(value)
    if not isinstance(node, dict):
        return
    for key, options in node.get("properties", {}).items():
        if NAMED_BY_KEY not in options:
            continue
        name, named_by = options.pop(GROUP_KEY), options.pop(NAMED_BY_KEY)
        options.pop("default", None)  # the default is the class's own
        # A table that names no class has the default one, which an editor need not know.
        node.setdefault("allOf", []).extend(
            {
                "if": {"properties": {named_by: {"const": each}}, "required": [named_by]},
                "then": {"properties": {key: {"$ref": f"#/$defs/{name}.{each}"}}},
            }
            for each in _GROUPS[name].working()
        )
        yield name
    if GROUP_KEY in node:
        name = node.pop(GROUP_KEY)
        del node["type"]
        node["$ref"] = f"#/$defs/{name}"
        yield name
    for value in list(node.values()):
        yield from _resolve_marks(value)
