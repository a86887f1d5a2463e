"""Cameras: their interface to the capture path, and drivers over several libraries."""
