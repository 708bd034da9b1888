"""Exit codes of the `vibrocast` command."""

FAILED = 1
"""The device, or the command itself, failed."""
BAD_INPUT = 2
INTERRUPTED = 130
"""As a shell gives for Ctrl-C."""
