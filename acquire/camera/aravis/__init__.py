"""Cameras through Aravis: GigE Vision and USB3 Vision without a maker's software. Optional.

The only package that uses Aravis. It needs only its shared library (Debian: libaravis-0.8-0), which is loaded
when a camera is opened. Calls through ctypes release the interpreter's lock, and a buffer's memory is
accessed without a copy. Aravis has no CoaXPress.
"""

from acquire.camera.aravis.bindings import load
from acquire.camera.aravis.camera import FAKE, AravisCamera, AravisOpener, list_cameras

__all__ = ["FAKE", "AravisCamera", "AravisOpener", "list_cameras", "load"]
