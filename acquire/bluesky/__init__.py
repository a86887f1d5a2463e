"""The instrument as a bluesky device: a plan records with it, and documents state where the lines are.

::

    import bluesky.plan_stubs as bps
    from acquire.bluesky import Recorder, StartRequest

    recorder = Recorder(name="recorder")           # as `acquire.client.Client`: default socket, path, or URL

    yield from bps.stage(recorder)                                        # armed
    yield from bps.prepare(recorder, StartRequest(duration_s=1.0))
    yield from bps.declare_stream(recorder, name="lines", collect=True)
    yield from bps.kickoff(recorder, wait=True)                           # recording
    yield from bps.abs_set(recorder.mark, "the valve opens")
    yield from bps.collect_while_completing([recorder], [recorder], flush_period=1.0, stream_name="lines")
    yield from bps.unstage(recorder)                                      # as it was before

Needs the extra ``bluesky``; the service itself does not.
"""

from acquire.daemon.messages import StartRequest
from acquire.exchange.libraries import library

for _module in ("bluesky.protocols", "event_model", "ophyd_async.core"):
    library(_module, "bluesky", "acquire.bluesky")

from acquire.bluesky.recorder import Recorder  # noqa: E402 - a missing package is named first

__all__ = ["Recorder", "StartRequest"]
