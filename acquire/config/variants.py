"""Tables whose ``kind`` or ``driver`` selects their model, which may be a plug-in's class.

A class is imported when a file names it (`acquire.plugins`), and its table is then validated by pydantic.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from pydantic_core import PydanticCustomError, SchemaValidator, core_schema

from acquire.errors import ConfigError
from acquire.plugins import Group

if TYPE_CHECKING:
    from pydantic import BaseModel, GetCoreSchemaHandler, GetJsonSchemaHandler
    from pydantic.json_schema import JsonSchemaValue

GROUP_KEY = "x-acquire-group"
"""Marks the place of a group's classes in an incomplete JSON schema (`acquire.config.schema`)."""
NAMED_BY_KEY = "x-acquire-named-by"
"""Marks the options of a class, in such a schema, with the key that names the class."""


@dataclass(frozen=True, slots=True)
class OneOf:
    """Annotates a field that is a table of one of a group's models, or such a model.

    Errors have the kind in their location, like those of pydantic's own unions.
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
            serialization=core_schema.simple_ser_schema("any"),  # serialised as its actual class
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
            raise PydanticCustomError("table", "a table with a kind was expected")
        kind = value.get("kind")
        if kind is None:
            kinds = ", ".join(self.group.names())
            raise PydanticCustomError("no_kind", "kind is missing; possible: {kinds}", {"kinds": kinds})
        model = _class_of(self.group, str(kind))
        return _tagged(kind, model).validate_python(value)


@dataclass(frozen=True, slots=True)
class NameOf:
    """Annotates a string that is the name of a class of a group."""

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
        return {"type": "string", "enum": list(dict.fromkeys([*self.group.built_in, *self.group.names()]))}

    def _known(self, name: str) -> str:
        if name not in self.group.built_in:
            _class_of(self.group, name)
        return name


@dataclass(frozen=True, slots=True)
class OptionsOf:
    """Annotates a table of the options of the class that a preceding field names: ``driver``, or another."""

    group: Group
    named_by: str = "driver"

    def __get_pydantic_core_schema__(
        self,
        source: Any,
        handler: GetCoreSchemaHandler,
    ) -> core_schema.CoreSchema:
        return core_schema.with_info_plain_validator_function(
            self._validated, serialization=core_schema.simple_ser_schema("any")
        )

    def __get_pydantic_json_schema__(
        self,
        schema: core_schema.CoreSchema,
        handler: GetJsonSchemaHandler,
    ) -> JsonSchemaValue:
        return {"type": "object", GROUP_KEY: self.group.name, NAMED_BY_KEY: self.named_by}

    def _validated(self, value: Any, info: core_schema.ValidationInfo) -> Any:
        driver = info.data.get(self.named_by)
        if driver is None:
            return None  # the driver itself was refused, which is already an error
        if driver in self.group.built_in:
            if value:
                what = f"{self.group.what} {driver!r}"
                raise PydanticCustomError("no_options", "{what} has no options", {"what": what})
            return None
        # Also for a table that is absent: its model then has the defaults, or refuses what it requires.
        model = _class_of(self.group, driver)
        if isinstance(value, model):
            return value
        return _tagged(driver, model).validate_python({} if value is None else value)


def _class_of(group: Group, name: str) -> Any:
    try:
        return group.load(name)
    except ConfigError as error:
        # A ConfigError would pass through pydantic as it is, without the file and the key.
        raise PydanticCustomError("unknown_kind", "{why}", {"why": str(error)}) from error


# Building a validator takes ten times as long as using it (10 µs).
@cache
def _tagged(kind: str, model: type[BaseModel]) -> SchemaValidator:
    """Return the validator of a union with one member, so that errors have its name in their location."""
    only = core_schema.no_info_plain_validator_function(model.model_validate)
    return SchemaValidator(core_schema.tagged_union_schema({kind: only}, discriminator=lambda _: kind))
