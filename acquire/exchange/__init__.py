"""Export of recordings and videos to the files of other programs, and import of other programs' lines.

::

    from_video, from_recording ─▶ content (in blocks) ─▶ tiff | hdf5 | arrays | movie ─▶ one file
    line files ─▶ foreign (blocks of lines) ─▶ importing, code_words ─▶ a sealed recording
    napari_reader, lazy · xarray_engine   found by napari and xarray through entry points

Data are read block by block as they are written, so memory stays bounded however long a recording is. The
libraries for these files are imported on demand; the extra ``[export]`` installs them.
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
