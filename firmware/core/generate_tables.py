"""Writes constant_tables.c, the mathematical tables of the core: `python firmware/core/generate_tables.py`."""

import math
from collections.abc import Sequence
from pathlib import Path

TABLES: dict[str, tuple[str, Sequence[float]]] = {
    "vc_cosine": ("int32_t", [2**24 * math.cos(2 * math.pi * i / 512) for i in range(512)]),
    "vc_stretch": ("int16_t", [256 * math.log((i + 0.5) / (2047.5 - i)) for i in range(2048)]),
    "vc_squash": ("uint16_t", [65536 / (1 + math.exp(-(4 * i - 2046) / 256)) for i in range(1024)]),
    "vc_cost": ("uint16_t", [-256 * math.log2((i + 0.5) / 2048) for i in range(2048)]),
}


def table_source(name: str, kind: str, values: Sequence[float]) -> str:
    """Return the C definition of one table, ten rounded values a line."""
    integers = [str(round(value)) for value in values]
    lines = [", ".join(integers[start : start + 10]) for start in range(0, len(integers), 10)]
    return f"const {kind} {name}[{len(values)}] = {{\n    " + ",\n    ".join(lines) + "};\n"


if __name__ == "__main__":
    definitions = "\n".join(table_source(name, kind, values) for name, (kind, values) in TABLES.items())
    head = '/* Mathematical tables; written by generate_tables.py. */\n#include "mdct.h"\n\n'
    Path(__file__).with_name("constant_tables.c").write_text(head + definitions)
