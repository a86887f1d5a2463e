"""The capture path: from cameras and trigger to a recording, each line counted.

::

    camera a ─▶ grabber a ─▶ ring a ─┬──────▶ recorder ─▶ Zarr
    camera b ─▶ grabber b ─▶ ring b ─┤   ┌──▶ (session, tagger)
    trigger  ─▶ supervisor ─▶ tags ──┼───┘       ▲ verdicts
                    ▲                └··▶ watcher┘
                    └── events ─────────────┘     (check of the code, thresholds)

Grabbers, recorder and watcher are processes, the supervisor is a thread; `Capture` owns them all. Rings are
shared memory: no pixel is sent between a camera's buffer and the recorder, and no camera waits for a reader.

`losses` and their causes · `ring` · `observer` of a ring, `peek` from outside · `messages` between the
processes · `grabber`, and `lineclock` after an absence · `tagger` · `window` of lines around an event, those
`kept` already · `opening` of a recording, `session` · `recorder`, its `recorder_plan` and `recorder_states` ·
`stalls` · `lightcheck`, `threshold`, `watcher` · `external_counts` of trigger, cameras and watcher · `ledger`
of every pulse · `plan` · `succession` of killed processes · `lifecycle` of a recording · `tag_feed` ·
`supervisor` · `capture`
"""

from acquire.stream.capture import Capture
from acquire.stream.messages import Begin, Note
from acquire.stream.plan import END_S, CapturePlan, CaptureStatus
from acquire.stream.succession import Orphan
from acquire.stream.window import NOW, Window

__all__ = ["END_S", "NOW", "Begin", "Capture", "CapturePlan", "CaptureStatus", "Note", "Orphan", "Window"]
