"""Recordings and videos on disk: Zarr v3 that zarr-python, xarray and tensorstore open without this package.

::

    whole recordings   writer                     reader, listing     verification recovery mirroring  video
      with             retention room resume      outline suspect     scan         mend     place
      kept from loss   reserve, holds, links      opening attributes  compare      rebuild
      removed          removal
      seen at once     overview                   extent shortfall
    videos             video_writer, mosaic_writer (tiles), video_layout (metadata)
    one arm            arm_writer                 camera_stream, present
    one array          array_writer → shard       stored_rows → chunks → array_files
    tables             table                      table_reader
    what is written    terms, spec (attributes), layout and shape (metadata), codecs (bytes)
      by others        variant → plugin_codecs, zarr_codec
    where              files, pages, host, mount  source → disk | remote (URLs)
      all or nothing   delivery, refusals
      replaced         swap

An `Outline` is a recording without its lines: it and everything that it uses need no array library. Names are
imported from here lazily, so that a list of recordings comes at once. No module may have the name of a
function: importing it would replace the function.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.lazy import lazily

if TYPE_CHECKING:
    from acquire.store.camera_stream import CameraStream
    from acquire.store.codecs import CodecChoice, choose_codec
    from acquire.store.files import measure_disk
    from acquire.store.holds import Hold
    from acquire.store.layout import FORMAT, READABLE
    from acquire.store.mirroring import Mirrored, mirror
    from acquire.store.mosaic_writer import MosaicWriter
    from acquire.store.opening import format_of
    from acquire.store.outline import Outline, open_outline
    from acquire.store.reader import Recording, open_recording
    from acquire.store.recovery import Circumstances, Recovery, recover
    from acquire.store.resume import next_segment
    from acquire.store.retention import hold
    from acquire.store.shape import Codec
    from acquire.store.spec import RecordingSpec, RunCondition
    from acquire.store.suspect import Suspect, suspect_lines, taint_words
    from acquire.store.table_reader import Event, Gap
    from acquire.store.terms import Continuation, Retention
    from acquire.store.verification import Verification, verify
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
    "MosaicWriter",
    "Outline",
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
    "open_outline",
    "open_recording",
    "open_video",
    "recover",
    "suspect_lines",
    "taint_words",
    "verify",
    "write_video",
]

_HOMES = {
    "CameraStream": "camera_stream",
    "Circumstances": "recovery",
    "Codec": "shape",
    "CodecChoice": "codecs",
    "Continuation": "terms",
    "Event": "table_reader",
    "FORMAT": "layout",
    "Gap": "table_reader",
    "Hold": "holds",
    "Mirrored": "mirroring",
    "MosaicWriter": "mosaic_writer",
    "Outline": "outline",
    "READABLE": "layout",
    "Recording": "reader",
    "RecordingSpec": "spec",
    "RecordingWriter": "writer",
    "Recovery": "recovery",
    "Retention": "terms",
    "RunCondition": "spec",
    "Suspect": "suspect",
    "Verification": "verification",
    "VideoFile": "video",
    "VideoGrid": "video_layout",
    "VideoWriter": "video_writer",
    "choose_codec": "codecs",
    "format_of": "opening",
    "hold": "retention",
    "measure_disk": "files",
    "mirror": "mirroring",
    "next_segment": "resume",
    "open_outline": "outline",
    "open_recording": "reader",
    "open_video": "video",
    "recover": "recovery",
    "suspect_lines": "suspect",
    "taint_words": "suspect",
    "verify": "verification",
    "write_video": "video",
}
"""Public name → the module that defines it."""

if not TYPE_CHECKING:  # a type checker would accept any name
    __getattr__, __dir__ = lazily(__name__, _HOMES, __all__)
