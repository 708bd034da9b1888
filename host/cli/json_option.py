"""Whether a command line asks for JSON, which must be known before it is parsed: its errors are JSON, too."""

from collections.abc import Sequence

OPTION = "--json"


def is_given(arguments: Sequence[str]) -> bool:
    """Return whether the arguments of the command have the option, before any --."""
    options = list(arguments)
    return OPTION in (options[: options.index("--")] if "--" in options else options)
