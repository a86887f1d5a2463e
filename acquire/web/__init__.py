"""The operator's page: a process of its own, an observer that nobody waits for.

::

    daemon ══ Unix socket ══▶ Hub (one subscription) ──────────┐
      │                                                        ├─▶ Page stream ─▶ browser: one connection
      └ rings, read-only ═══▶ Live (a thread) ─▶ pictures ─────┘
    recordings' directory ══▶ Archive, Jobs (queue of one) ───────▶ requests

Its defects cannot cost a line: it maps the rings read-only, its commands go to the daemon as anybody's do,
and a browser that does not read is disconnected. Killed, it leaves nothing; the daemon starts it anew.
"""
