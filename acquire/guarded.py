"""Objects of plug-ins whose calls are checked, so that an error names the plug-in.

Without this, an answer of a wrong type, or any error that is not one of ours, shows where the answer is used:
in our modules, as a defect of ours.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from acquire.errors import AcquireError, DeviceError, UsageError
from acquire.text import shortened, shown, system_words

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping


AUTHOR = "its author, or another version of the distribution"
"""Who can mend a plug-in that makes a mistake."""


@dataclass(frozen=True, slots=True)
class Expected:
    """What a call has to give back: a test of it, and its description."""

    fits: Callable[[Any], bool]
    words: str

    @classmethod
    def of_type(cls, kind: type, words: str = "") -> Expected:
        """Return the expectation of an object of a class."""
        return cls(lambda found: isinstance(found, kind), words or f"a {kind.__name__}")

    @classmethod
    def with_methods(cls, protocol: type, *names: str) -> Expected:
        """Return the expectation of an object with these methods of a protocol."""
        return cls(
            lambda found: all(callable(getattr(found, name, None)) for name in names),
            f"a {protocol.__name__}, which has {', '.join(names)}",
        )


def checked_call(
    whose: str,
    name: str,
    work: Callable[[], Any],
    expected: Expected | None,
    failure: type[DeviceError] = DeviceError,
) -> Any:
    """Return what a plug-in's method gives back; ``whose`` is its kind, name and distribution.

    Raises UsageError if that is not as expected, and ``failure`` for any error that is not one of ours.
    """
    try:
        found = work()
    except AcquireError:
        raise
    except Exception as error:
        why = shortened(f"{type(error).__name__}: {error}".removesuffix(": "), 400)
        raise failure(
            f"{whose} failed in {name}: {why}", hint=f"its cable and options; else {AUTHOR}"
        ) from error
    if expected is not None and not expected.fits(found):
        raise UsageError(
            f"{whose} gave back {shown(found)} from {name}", possible=expected.words, hint=AUTHOR
        )
    return found


class Guarded:
    """An object of a plug-in: it has the same attributes, and every call of a method is a `checked_call`."""

    def __init__(
        self, whose: str, inner: object, expected: Mapping[str, Expected], failure: type[DeviceError]
    ) -> None:
        self._whose, self._inner, self._expected, self._failure = whose, inner, expected, failure

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._inner, name)
        return partial(self._call, name, found) if callable(found) else found

    def _call(self, name: str, method: Callable[..., Any], *args: Any, **options: Any) -> Any:
        work = partial(method, *args, **options)
        return checked_call(self._whose, name, work, self._expected.get(name), self._failure)


@contextmanager
def files_read(whose: str, doing: str) -> Iterator[None]:
    """Raise UsageError, which names the plug-in, for a file that it cannot read while it is set up."""
    try:
        yield
    except OSError as error:
        raise UsageError(
            f"{whose} cannot be {doing}: {system_words(error)}",
            possible="files that exist and may be read",
            hint="the paths among its keys; PLUGINS.md states what they are relative to",
        ) from error
