"""Writes Wireshark's dissector, vibrocast.lua, from the messages: `python -m vibrocast.harness.dissector`."""

import argparse
from enum import IntEnum
from pathlib import Path

from vibrocast import pages
from vibrocast.device_protocol import layout, messages
from vibrocast.device_protocol.generate import NESTED, fixed_fields, snake
from vibrocast.device_protocol.layout import WireField, wire_fields

DISSECTOR = Path(__file__).with_name("vibrocast.lua")
_TYPES = {
    "u8": "uint8",
    "u16": "uint16",
    "u32": "uint32",
    "u64": "uint64",
    "i64": "int64",
    "f32": "float",
    "text": "string",
    "varint": "uint32",
    "counted": "string",
}


def dissector() -> str:
    """Return the dissector: the template next to this module, with the fields of all messages."""
    return pages.render(
        DISSECTOR.with_suffix(".lua.jinja"),
        messages=messages,
        layout=layout,
        all_messages=messages.ALL,
        owners=(*messages.ALL, *NESTED),
        nested=NESTED,
        snake=snake,
        lua_fields=_fields,
        lua_values=_values,
        wire_fields=wire_fields,
    )


def _values(field: WireField) -> str:
    """Return the names of an enumeration's numbers as a table of Lua, "nil" for any other field."""
    if not (isinstance(field.type, type) and issubclass(field.type, IntEnum)):
        return "nil"
    return "{" + ", ".join(f'[{member.value}] = "{member.name}"' for member in field.type) + "}"


def _fields(owner: type) -> list[tuple[str, str, str, str]]:
    """Return name, kind for `read`, type of the ProtoField and names of values of each field but those in tags."""
    return [(field.name, kind, _TYPES.get(kind, "bytes"), _values(field)) for field, kind in fixed_fields(owner)]


if __name__ == "__main__":
    argparse.ArgumentParser(description="Write Wireshark's dissector of the protocol.").parse_args()
    DISSECTOR.write_text(dissector(), encoding="utf-8")
