"""Python functions that C calls; their exceptions wait until C has returned."""

from collections.abc import Callable
from typing import Any


class Callbacks:
    """Makes callbacks for C. After one has raised, all of them do nothing, and `pass_on` raises it again."""

    def __init__(self, ffi: Any) -> None:
        self._ffi = ffi
        self._raised: list[BaseException] = []

    def make(self, kind: str, function: Callable[..., Any], failed: int | None = None) -> Any:
        """Return a pointer to a function of a C type, valid while you keep it; it returns `failed` if it raises."""
        raised = self._raised

        def call(*arguments: Any) -> Any:
            if raised:
                return failed
            try:
                return function(*arguments)
            except BaseException as error:
                raised.append(error)
                return failed

        return self._ffi.callback(kind, call)

    @property
    def raised(self) -> bool:
        """Whether a callback has raised an exception."""
        return bool(self._raised)

    def pass_on(self) -> None:
        """Raise the exception of a callback, if there is one."""
        if self._raised:
            raise self._raised[0]
