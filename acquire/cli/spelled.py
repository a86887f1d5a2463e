"""Options of a command from a declaration that the Python API shares (`acquire.daemon.options`).

::

    class StartOptions(TypedDict):  pre_s: Annotated[float, Help("Begin …")]
        ▼ @spelled
    def start(*, json, **options: Unpack[StartOptions])   ▶   acquire start --pre TIME  Begin …
"""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.durations import seconds
from acquire.daemon.options import Help, one_by_one

if TYPE_CHECKING:
    from collections.abc import Callable

UNIT = "_s"
"""End of the name of a duration, which the command line does without: it takes `500ms` and `2min`."""


def spelled(command: Callable[..., None]) -> Callable[..., None]:
    """Replace ``**options: Unpack[Options]`` by the options of ``Options`` that have a `Help`.

    The command gets those that were given. In its help, they come before its keyword-only parameters.
    """
    own = inspect.signature(command, eval_str=True)
    *_, options = own.parameters.values()
    declared = options.annotation.__args__[0].__annotations__
    added = {name: _option(name, kind) for name, kind in declared.items() if hasattr(kind, "__metadata__")}

    @functools.wraps(command)
    def with_given(**values: Any) -> None:
        command(**{name: value for name, value in values.items() if name not in added or value is not None})

    with_given.__signature__ = one_by_one(own, added.values())  # type: ignore[attr-defined]
    return with_given


def _option(name: str, declared: Any) -> inspect.Parameter:
    """Return the parameter of which typer makes an option; its value is None if it is not given."""
    kind = declared.__origin__
    is_flag, is_time = kind is bool, name.endswith(UNIT)
    (about,) = (one for one in declared.__metadata__ if isinstance(one, Help))
    option = typer.Option(
        "--" + name.removesuffix(UNIT).replace("_", "-"),
        parser=seconds if is_time else None,
        metavar="TIME" if is_time else None,
        help=about.text,
    )
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=False if is_flag else None,
        annotation=Annotated[kind if is_flag else kind | None, option],
    )
