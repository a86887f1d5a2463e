"""Cameras: what the capture path asks of one, whatever library drives it."""
