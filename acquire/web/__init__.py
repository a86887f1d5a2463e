"""The operator's page: a separate process that only observes, and that nothing waits for.

::

    daemon ══ Unix socket ══▶ Hub (one subscription) ──────────┐
      │                                                        ├─▶ Page stream ─▶ browser: one connection
      └ rings, read-only ═══▶ Live (a thread) ─▶ pictures ─────┘
    recordings' directory ══▶ Archive, Jobs (queue of one) ───────▶ requests

Its defects cannot cost a line: it maps the rings read-only, sends its commands to the daemon as any client
does, and disconnects a browser that does not read. It leaves nothing behind when killed, and the daemon
restarts it.
"""
