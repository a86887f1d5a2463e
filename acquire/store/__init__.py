"""Recordings and videos on disk: Zarr v3 that zarr-python, xarray and tensorstore open without us.

Downwards: `writer` · `reader` · `video`; `arm_writer` · `camera_stream` one arm; `table` gaps and events;
`layout` metadata; `spec` what a recording says of itself; `shard` one growing array; `files` the disk.
"""

from acquire.store.camera_stream import CameraStream
from acquire.store.reader import Event, Gap, Recording, format_of, open_recording
from acquire.store.spec import FORMAT, RecordingSpec, RunCondition
from acquire.store.video import VideoFile, VideoWriter, open_video, write_video
from acquire.store.writer import RecordingWriter

__all__ = [
    "FORMAT",
    "CameraStream",
    "Event",
    "Gap",
    "Recording",
    "RecordingSpec",
    "RecordingWriter",
    "RunCondition",
    "VideoFile",
    "VideoWriter",
    "format_of",
    "open_recording",
    "open_video",
    "write_video",
]
