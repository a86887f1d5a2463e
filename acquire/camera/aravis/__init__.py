"""Cameras through Aravis: GigE Vision and USB3 Vision without a maker's software. Optional.

The only package that knows Aravis, and it asks for nothing but its shared library (Debian: libaravis-0.8-0),
which is loaded when a camera is opened. Calls through ctypes release the interpreter's lock, and a buffer's
memory is seen without a copy. Aravis has no CoaXPress.
"""

from acquire.camera.aravis.bindings import load
from acquire.camera.aravis.camera import FAKE, AravisCamera, AravisOpener, list_cameras

__all__ = ["FAKE", "AravisCamera", "AravisOpener", "list_cameras", "load"]
