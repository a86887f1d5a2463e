"""Names shared by the program and the shell's completion script."""

PROGRAM = "acquire"
VARIABLE = "_ACQUIRE_COMPLETE"
"""Environment variable that the shell sets when it asks for completions."""
