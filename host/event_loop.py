"""One event loop in one thread for the work with one controller or with many, none of which waits for another."""

import contextlib
import heapq
import itertools
import selectors
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from vibrocast.device_protocol.transports import TransportError
from vibrocast.host.controller import Controller, Sleep, Steps

_Result = TypeVar("_Result")
_Key = TypeVar("_Key", bound=Hashable)

# So often the loop looks at transports that have no file to wait for, which are those in simulated time.
_POLL_S = 0.002
# The simulated clock counts microseconds.
_MIN_SLEEP_S = 1e-6


@dataclass(eq=False)
class _Member(Generic[_Key]):
    """A controller that the loop serves.

    `wait`: what its last step yielded. `due_s`: when it is over. `file`, its `descriptor`, `events`: what the loop
    waits for.
    """

    key: _Key
    controller: Controller
    steps: Steps[Any]
    wait: float = 0.0
    due_s: float = 0.0
    file: Any = None
    descriptor: int | None = None
    events: int = 0
    ended: bool = False

    @property
    def pauses(self) -> bool:
        """Whether nothing is to be read."""
        return isinstance(self.wait, Sleep)


def run_all(works: Mapping[_Key, tuple[Controller, Steps[_Result]]]) -> dict[_Key, _Result | Exception]:
    """Do the work with all controllers at once; return by key what each gave or raised.

    All have the same clock. KeyboardInterrupt, and whatever else is no Exception, is raised in every step that waits;
    the caller gets it when all have ended.
    """
    if len(works) != 1:
        return _Loop[_Key, _Result](works).run()
    ((key, work),) = works.items()
    try:
        controller, steps = work
        return {key: controller.run(steps)}
    except Exception as error:
        return {key: error}


class _Loop(Generic[_Key, _Result]):
    """`_due`: when members are due, the next first; those that have been served meanwhile are there more than once."""

    def __init__(self, works: Mapping[_Key, tuple[Controller, Steps[_Result]]]) -> None:
        self._results: dict[_Key, _Result | Exception] = {}
        self._members = [_Member(key, controller, steps) for key, (controller, steps) in works.items()]
        self._left = len(self._members)
        self._due: list[tuple[float, int, _Member[_Key]]] = []
        self._number = itertools.count()
        self._selector = selectors.DefaultSelector()
        self._polled: set[_Member[_Key]] = set()
        self._interrupt: BaseException | None = None

    def run(self) -> dict[_Key, _Result | Exception]:
        for member in self._members:
            member.controller.make_selectable()
        try:
            for member in self._members:
                if not member.ended:
                    self._step(member, next, member.steps)
            while self._left:
                try:
                    self._serve()
                except BaseException as interrupt:  # while the loop waits
                    self._interrupt_all(interrupt)
        finally:
            self._selector.close()
        if self._interrupt is not None:
            raise self._interrupt
        return {member.key: self._results[member.key] for member in self._members}

    def _serve(self) -> None:
        """Wait until something comes or is due, and serve those whom it concerns."""
        clock = self._members[0].controller.clock
        while self._due and (self._due[0][2].ended or self._due[0][0] != self._due[0][2].due_s):
            heapq.heappop(self._due)
        for member in self._wait(max(0.0, self._due[0][0] - clock())):
            if not (member.ended or member.pauses):
                self._read(member)
        now_s = clock()
        due = []
        while self._due and self._due[0][0] <= now_s:
            due_s, _, member = heapq.heappop(self._due)
            if not member.ended and member.due_s == due_s:
                due.append(member)
        for member in due:
            if not member.ended:
                self._step(member, member.steps.send, b"")

    def _wait(self, timeout_s: float) -> list[_Member[_Key]]:
        """Return those whose files are ready, and all that have none, after `timeout_s` at most."""
        watches = bool(self._selector.get_map())
        if timeout_s and (self._polled or not watches):
            timeout_s = max(_MIN_SLEEP_S, min(timeout_s, _POLL_S) if self._polled else timeout_s)
            self._members[0].controller.sleep(timeout_s)
            timeout_s = 0.0
        ready = self._selector.select(timeout_s) if watches else []
        return [*self._polled, *(key.data for key, _ in ready)]

    def _read(self, member: _Member[_Key]) -> None:
        """Read what has come for a member, and do its next step unless it may wait on."""
        was_sending = member.controller.is_sending
        try:
            data = member.controller.read(0.0)
        except TransportError as error:
            self._step(member, member.steps.throw, error)
            return
        if data or member.controller.is_sending != was_sending:
            self._step(member, member.steps.send, data)

    def _step(self, member: _Member[_Key], step: Callable[..., float], *arguments: Any) -> None:
        """Do one step of a member; note when the next is due, or how it ended."""
        try:
            member.wait = step(*arguments)
            member.due_s = member.controller.clock() + member.wait
            heapq.heappush(self._due, (member.due_s, next(self._number), member))
            self._watch(member)
            return
        except StopIteration as end:
            self._results[member.key] = end.value
        except Exception as error:  # of one controller: the others go on
            self._results[member.key] = error
        except BaseException as interrupt:
            self._end(member)
            if interrupt is not self._interrupt:
                self._interrupt_all(interrupt)
            return
        self._end(member)

    def _end(self, member: _Member[_Key]) -> None:
        member.ended = True
        self._left -= 1
        self._watch(member)

    def _interrupt_all(self, interrupt: BaseException) -> None:
        """Raise an interruption in every step that waits; a second one ends the loop at once."""
        if self._interrupt is not None:
            raise interrupt
        self._interrupt = interrupt
        for member in self._members:
            if not member.ended:
                self._step(member, member.steps.throw, interrupt)

    def _watch(self, member: _Member[_Key]) -> None:
        """Update the events of a member that the selector waits for."""
        waits = not (member.ended or member.pauses)
        file = member.controller.file if waits else None
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if member.controller.is_sending else 0)
        if file is not None and file is member.file and events == member.events:
            return
        if member.descriptor is not None:
            self._selector.unregister(member.descriptor)
        member.file, member.events, member.descriptor = file, events, None
        if file is not None:
            with contextlib.suppress(OSError, ValueError):  # a closed port: reading it tells why
                member.descriptor = file.fileno()
                self._selector.register(member.descriptor, events, member)
        (self._polled.add if waits and member.descriptor is None else self._polled.discard)(member)
