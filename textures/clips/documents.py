"""Reads the JSON documents of clips into typed structs, and their points into arrays."""

import re
from collections.abc import Iterable
from typing import Annotated, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from vibrocast.textures.clips.synthesis import MAX_SECONDS
from vibrocast.textures.recording import Signal

Kind = TypeVar("Kind")
Seconds = Annotated[float, Meta(ge=0, le=MAX_SECONDS)]
Unit = Annotated[float, Meta(ge=0, le=1)]

_MAX_NAMED, _MAX_CHARACTERS = 10, 40
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_STRING_OR_LAST_COMMA = re.compile(rb'("(?:[^"\\]|\\.)*")|,(?=\s*[\]}])', re.DOTALL)


def read_json(data: bytes, kind: type[Kind]) -> Kind:
    """Return a JSON document as a struct; it may begin with a byte order mark, and have commas before brackets.

    Both stand in files that people edit. Raises msgspec.DecodeError, and RecursionError.
    """
    text = data.removeprefix(_BYTE_ORDER_MARK)
    try:
        return msgspec.json.decode(text, type=kind)
    except msgspec.ValidationError:
        raise
    except msgspec.DecodeError:
        return msgspec.json.decode(_STRING_OR_LAST_COMMA.sub(rb"\1", text), type=kind)


def polyline(points: Iterable[tuple[float, float]], name: str) -> tuple[Signal, Signal]:
    """Return the times (n,) and values (n,) of one or more points, for numpy.interp. Two at one time are a step.

    Raises ValueError if a time falls.
    """
    times, values = np.array(list(points), dtype=np.float64).T
    if np.any(np.diff(times) < 0):
        raise ValueError(f"the times of its {name} fall; put the points into order")
    return times, values


def left_out(names: Iterable[str]) -> tuple[str, ...]:
    """Return the note on names of a file's contents that were not rendered; none if there are none."""
    each = sorted({name[:_MAX_CHARACTERS] for name in names})
    more = " and others" if len(each) > _MAX_NAMED else ""
    return (f"left out: {', '.join(each[:_MAX_NAMED])}{more}",) if each else ()
