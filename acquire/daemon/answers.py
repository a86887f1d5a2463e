"""Commands are carried out once, however often they are sent: a request's id gives its answer again.

A client that has lost the answer, since the connection broke, cannot know whether its command was carried
out. It sends the same request with the same id again, and gets what the first one got.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from acquire.daemon.messages import Status

MOST_KEPT = 256
"""Answers that are remembered; the oldest is forgotten first."""
LONGEST_ID = 128


@dataclass(slots=True)
class _Kept:
    asked: str
    answer: asyncio.Future[Status]


class Answers:
    """Of one event loop."""

    def __init__(self, kept: int = MOST_KEPT) -> None:
        self._most = kept
        self._kept: OrderedDict[str, _Kept] = OrderedDict()

    async def once(self, request_id: str | None, asked: str, work: Callable[[], Awaitable[Status]]) -> Status:
        """Carry ``work`` out, or give the answer, or error, of the request that had this id.

        ``asked`` says what is asked for. Raises UsageError where the id was given to something else. The work
        goes on to its end although whoever asked for it is gone.
        """
        known = self._kept.get(request_id) if request_id is not None else None
        if known is not None and known.asked != asked:
            raise UsageError(
                f"request id {request_id} was given to another request before",
                hint="a new id for every request",
            )
        if known is None:
            known = _Kept(asked, asyncio.ensure_future(work()))
            known.answer.add_done_callback(_heard)
            if request_id is not None:
                self._kept[request_id] = known
                # What is still under way is not forgotten: it would be carried out twice.
                over = [key for key, kept in self._kept.items() if kept.answer.done()]
                for key in over[: max(0, len(self._kept) - self._most)]:
                    del self._kept[key]
        # A client that goes away cancels its request, and not the command that is being carried out.
        return await asyncio.shield(known.answer)


def _heard(answer: asyncio.Future[Status]) -> None:
    """An error whose client has gone is not asyncio's matter: the service has logged it."""
    if not answer.cancelled():
        answer.exception()
