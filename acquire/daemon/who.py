"""The user behind a request: passed on to the daemon, which records it.

It is a claim, not a proof: everybody who reaches the control socket is the daemon's user. The page's process
has verified a token, and states its role and the client's address.
"""

from __future__ import annotations

from contextvars import ContextVar

LONGEST = 120
HEADER = "Acquire-By"
WHO: ContextVar[str] = ContextVar("acquire_who", default="")
"""Empty: unknown."""
