"""Names that the shell's completion and the program agree on."""

PROGRAM = "acquire"
VARIABLE = "_ACQUIRE_COMPLETE"
"""Set while Tab asks what fits."""
