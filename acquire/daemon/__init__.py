"""The capture service: a process that owns the devices, and the API over which it is controlled.

::

    acquire arm ──▶ client ══ HTTP + JSON over a Unix socket ══▶ control ──▶ service ──▶ Capture
                                     (messages)                   server      states      devices

``states`` is the state machine; ``service`` works on the devices, in one thread; ``proof`` measures what the
host sustains before a run; ``salvage`` recovers recordings that a killed process left open; ``uploads`` has
recordings copied to a remote store, by the process ``copier``. ``control`` is the API; ``server`` is the
process: socket, signals, supervision.
"""
