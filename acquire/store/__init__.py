"""Recordings and videos on disk: Zarr v3 that zarr-python, xarray and tensorstore open without us.

::

    whole recordings   writer                     reader, opening, suspect  verify  recover  mirror  video
      with             retention room resume      attributes extent         scan    mend     place
      kept from loss   removal, links             shortfall                         rebuild
    one arm            arm_writer                 camera_stream
    one array          array_writer → shard       stretch → chunks          tables: table, table_reader
    what is written    terms, spec (attributes), layout (metadata), codecs (bytes)
    where              files (disk), pages, host  source → disk | remote (URLs)
"""

from acquire.store.camera_stream import CameraStream
from acquire.store.codecs import Codec, CodecChoice, choose_codec
from acquire.store.files import measure_disk
from acquire.store.mirror import Mirrored, mirror
from acquire.store.opening import format_of, open_recording
from acquire.store.reader import Recording
from acquire.store.recover import Circumstances, Recovery, recover
from acquire.store.resume import next_segment
from acquire.store.retention import Hold, hold
from acquire.store.spec import FORMAT, READABLE, RecordingSpec, RunCondition
from acquire.store.suspect import Suspect, suspect_lines
from acquire.store.table_reader import Event, Gap
from acquire.store.terms import Continuation, Retention
from acquire.store.verify import Verification, verify
from acquire.store.video import VideoFile, open_video, write_video
from acquire.store.video_layout import VideoGrid
from acquire.store.video_writer import VideoWriter
from acquire.store.writer import RecordingWriter

__all__ = [
    "FORMAT",
    "READABLE",
    "CameraStream",
    "Circumstances",
    "Codec",
    "CodecChoice",
    "Continuation",
    "Event",
    "Gap",
    "Hold",
    "Mirrored",
    "Recording",
    "RecordingSpec",
    "RecordingWriter",
    "Recovery",
    "Retention",
    "RunCondition",
    "Suspect",
    "Verification",
    "VideoFile",
    "VideoGrid",
    "VideoWriter",
    "choose_codec",
    "format_of",
    "hold",
    "measure_disk",
    "mirror",
    "next_segment",
    "open_recording",
    "open_video",
    "recover",
    "suspect_lines",
    "verify",
    "write_video",
]
