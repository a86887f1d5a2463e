"""Who asks, on the way through one request: what passes it on tells the daemon, which writes it down.

A claim, not a proof: whoever reaches the control socket is the daemon's user. The page's process has seen a
token, and says which role it was for, and from where.
"""

from __future__ import annotations

from contextvars import ContextVar

LONGEST = 120
HEADER = "Acquire-By"
WHO: ContextVar[str] = ContextVar("acquire_who", default="")
"""Empty: nobody has said."""
