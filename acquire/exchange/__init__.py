"""Recordings and videos in the files of other programs, and lines of other programs as recordings.

::

    from_video, from_recording ─▶ content (in blocks) ─▶ tiff | hdf5 | arrays | movie ─▶ one file
    line files ─▶ foreign (blocks of lines) ─▶ importing ─▶ a sealed recording

Nothing is read before it is written: memory stays bounded, however long a recording is. Libraries that only
these files need are imported when one is asked for; the extra ``[export]`` brings them.
"""

from acquire.exchange.content import Content
from acquire.exchange.export import SUFFIXES, check_export, export
from acquire.exchange.from_recording import recording_content
from acquire.exchange.from_video import video_content

__all__ = ["SUFFIXES", "Content", "check_export", "export", "recording_content", "video_content"]
