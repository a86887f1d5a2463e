"""The options of a command, as keywords, are the fields of its message, and show in signatures."""

from __future__ import annotations

import inspect
from typing import Any, get_type_hints

import pytest
import typer

from acquire.cli.usage import build
from acquire.client import AsyncClient, Client
from acquire.daemon import messages
from acquire.daemon.messages import ArmRequest, StartRequest
from acquire.daemon.options import ArmOptions, StartOptions


@pytest.mark.parametrize(
    ("options", "message", "apart"), [(ArmOptions, ArmRequest, set()), (StartOptions, StartRequest, {"path"})]
)
def test_options_are_the_fields_of_the_message(options: Any, message: Any, apart: set[str]) -> None:
    fields = {name: field.annotation for name, field in message.model_fields.items() if name not in apart}
    assert get_type_hints(options, localns=vars(messages)) == fields


@pytest.mark.parametrize("client", [Client, AsyncClient])
@pytest.mark.parametrize(("command", "message"), [("arm", ArmRequest), ("start", StartRequest)])
def test_a_running_program_sees_every_option_with_its_default(
    client: Any, command: str, message: Any
) -> None:
    parameters = inspect.signature(getattr(client, command)).parameters
    assert parameters.keys() == {"self", "request_id", *message.model_fields}
    assert {name: parameters[name].default for name in message.model_fields} == dict(message())


def test_the_command_line_has_the_options_that_have_help() -> None:
    commands = typer.main.get_command(build(["control"])).commands  # type: ignore[attr-defined]
    start = {option.opts[0] for option in commands["start"].params}
    assert start == {"path", "--lines", "--duration", "--pre", "--post", "--resume", "--socket", "--json"}
    arm = {option.opts[0] for option in commands["arm"].params}
    assert arm == {"--force", "--code", "--without-calibration", "--socket", "--json"}
