"""Commands are carried out once, however often they are sent: a repeated request ID gets the same answer.

A client that lost the answer because the connection broke cannot know whether its command was carried out. It
sends the same request with the same ID again, and gets the answer of the first one.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

T = TypeVar("T")

MOST_KEPT = 256
"""Number of answers that are kept; the oldest is dropped first."""


@dataclass(slots=True)
class _Kept:
    request: str
    answer: asyncio.Future[Any]


class Answers:
    """The answers of one event loop."""

    def __init__(self, kept: int = MOST_KEPT) -> None:
        self._most = kept
        self._kept: OrderedDict[str, _Kept] = OrderedDict()

    async def once(self, request_id: str | None, request: str, work: Callable[[], Awaitable[T]]) -> T:
        """Carry out ``work``, or return the answer, or raise the error, of an earlier request with this ID.

        ``request`` describes the request. Raises UsageError if the ID was used for a different one. The work
        is completed even if the client goes away.
        """
        known = self._kept.get(request_id) if request_id is not None else None
        # Otherwise the client would take the answer to something else for its own.
        if known is not None and known.request != request:
            raise UsageError(
                f"request id {request_id} was given to another request before",
                hint="a new id for every request",
            )
        if known is None:
            known = _Kept(request, asyncio.ensure_future(work()))
            known.answer.add_done_callback(_retrieve)
            if request_id is not None:
                self._kept[request_id] = known
                # Requests still being carried out are kept: repeating one would carry it out twice.
                over = [key for key, kept in self._kept.items() if kept.answer.done()]
                for key in over[: max(0, len(self._kept) - self._most)]:
                    del self._kept[key]
        # A client that goes away cancels its request, but not the command being carried out.
        answer: T = await asyncio.shield(known.answer)
        return answer


def _retrieve(answer: asyncio.Future[Any]) -> None:
    """Retrieve the error, which asyncio would report if the client is gone; it is logged already."""
    if not answer.cancelled():
        answer.exception()
