"""Tables whose ``kind`` decides what they may hold, whoever's class that is.

A class is imported when a file names it (`acquire.plugins`); pydantic then knows the rest. The JSON schema of
such a table is that of every class that is installed and works.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from pydantic import (
    BaseModel,
    BeforeValidator,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    SerializeAsAny,
    ValidationInfo,
)
from pydantic_core import PydanticCustomError, SchemaValidator, core_schema

from acquire.config.base import FrozenModel
from acquire.errors import ConfigError
from acquire.plugins import GROUPS, Group

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pydantic.json_schema import JsonSchemaValue

GROUP_KEY = "x-acquire-group"
"""Marks, in a JSON schema that is not yet whole, where the classes of a group go."""


@dataclass(frozen=True, slots=True)
class OneOf:
    """Annotates a field: a table of one of a group's models, or such a model. Errors have its kind in their
    location, as those of pydantic's own unions.
    """

    group: Group
    base: type[BaseModel]

    def __get_pydantic_core_schema__(
        self,
        source: Any,
        handler: GetCoreSchemaHandler,
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(
            self._validated,
            serialization=core_schema.simple_ser_schema("any"),  # as the class that it is
        )

    def __get_pydantic_json_schema__(
        self,
        schema: core_schema.CoreSchema,
        handler: GetJsonSchemaHandler,
    ) -> JsonSchemaValue:
        return {"type": "object", GROUP_KEY: self.group.name}

    def _validated(self, value: Any) -> Any:
        if isinstance(value, self.base):
            return value
        if not isinstance(value, dict):
            raise PydanticCustomError("table", "a table with its kind was expected")
        kind = value.get("kind")
        if kind is None:
            kinds = ", ".join(self.group.names())
            raise PydanticCustomError("no_kind", "kind is missing; possible: {kinds}", {"kinds": kinds})
        model = _class_of(self.group, str(kind))
        return _tagged(kind, model).validate_python(value)


@dataclass(frozen=True, slots=True)
class NameOf:
    """Annotates a text: the name of a class of a group."""

    group: Group

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_after_validator_function(self._known, handler(source))

    def __get_pydantic_json_schema__(
        self,
        schema: core_schema.CoreSchema,
        handler: GetJsonSchemaHandler,
    ) -> JsonSchemaValue:
        return {"type": "string", "enum": list(self.group.names())}

    def _known(self, name: str) -> str:
        _class_of(self.group, name)
        return name


Options = SerializeAsAny[FrozenModel | None]
"""A table of whichever class's options `options_of` says; None before that."""


def options_of(group: Group) -> BeforeValidator:
    """Annotates ``options``: those of the class that the field ``driver`` before it names."""

    def validated(value: Any, info: ValidationInfo) -> Any:
        if "driver" not in info.data:
            return None  # what it is was refused
        model = _class_of(group, info.data["driver"])
        return value if isinstance(value, model) else model.model_validate({} if value is None else value)

    return BeforeValidator(validated)

    return validated


def _class_of(group: Group, name: str) -> Any:
    try:
        return group.load(name)
    except ConfigError as error:
        raise PydanticCustomError("unknown_kind", "{why}", {"why": str(error)}) from error


@cache
def _tagged(kind: str, model: type[BaseModel]) -> SchemaValidator:
    """A union of one."""
    only = core_schema.no_info_plain_validator_function(model.model_validate)
    return SchemaValidator(core_schema.tagged_union_schema({kind: only}, discriminator="kind"))


def whole_schema(model: type[BaseModel]) -> dict[str, Any]:
    """The JSON schema of a model, with the classes of every group that it has a place for."""
    schema = model.model_json_schema()
    definitions = schema.setdefault("$defs", {})
    known = {group.name: group for group in GROUPS}
    waiting = list(_fill(schema))
    while waiting:
        name = waiting.pop()
        if name in definitions:
            continue
        choices = known[name].working()
        refs = {kind: f"#/$defs/{name}.{kind}" for kind in choices}
        definitions[name] = {
            "oneOf": [{"$ref": ref} for ref in refs.values()],
            "discriminator": {"propertyName": "kind", "mapping": refs},
        }
        for kind, choice in choices.items():
            one = choice.model_json_schema(ref_template=f"#/$defs/{name}.{kind}.{{model}}")
            below = one.pop("$defs", {})
            definitions[f"{name}.{kind}"] = one
            definitions.update({f"{name}.{kind}.{key}": value for key, value in below.items()})
            waiting += _fill([one, below])
    return schema


def _fill(node: Any) -> Iterator[str]:
    """Replace every group's mark by a reference to its definition; the names of these groups."""
    if isinstance(node, dict):
        if GROUP_KEY in node:
            name = node.pop(GROUP_KEY)
            node.pop("type")
            node["$ref"] = f"#/$defs/{name}"
            yield name
        for value in node.values():
            yield from _fill(value)
    elif isinstance(node, list):
        for value in node:
            yield from _fill(value)
