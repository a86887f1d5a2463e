"""Recordings and videos in the files of other programs, and lines of other programs as recordings.

::

    from_video, from_recording ─▶ content (in blocks) ─▶ tiff | hdf5 | arrays | movie ─▶ one file
    line files ─▶ foreign (blocks of lines) ─▶ importing, code_words ─▶ a sealed recording
    napari_reader, lazy · xarray_engine   found by their programs through entry points

Nothing is read before it is written: memory stays bounded, however long a recording is. Libraries that only
these files need are imported when one is asked for; the extra ``[export]`` brings them.
"""

from acquire.exchange.code_words import parse_code
from acquire.exchange.content import Content
from acquire.exchange.export import SUFFIXES, check_export, export, left_out
from acquire.exchange.foreign import Layout, LineFile, open_lines
from acquire.exchange.from_recording import recording_content
from acquire.exchange.from_video import video_content
from acquire.exchange.importing import Arm, Imported, Instrument, clock_of, import_lines

__all__ = [
    "SUFFIXES",
    "Arm",
    "Content",
    "Imported",
    "Instrument",
    "Layout",
    "LineFile",
    "check_export",
    "clock_of",
    "export",
    "import_lines",
    "left_out",
    "open_lines",
    "parse_code",
    "recording_content",
    "video_content",
]
