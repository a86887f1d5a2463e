"""Plug-ins whose own library was forgotten."""

import library_that_nobody_installed  # noqa: F401
