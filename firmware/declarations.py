"""The parts of C headers that cffi can parse."""

import re
from graphlib import TopologicalSorter
from pathlib import Path


def cffi_declarations(folder: Path) -> str:
    """Return the parts between `/* cffi: begin */` and `/* cffi: end */` of a folder's headers.

    A header's part comes after those of the headers that it includes.
    """
    texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.h"))}
    included = {
        name: [other for other in re.findall(r'#include "(.*?)"', text) if other in texts]
        for name, text in texts.items()
    }
    text = "\n".join(texts[name] for name in TopologicalSorter(included).static_order())
    declared = "\n".join(re.findall(r"/\* cffi: begin \*/(.*?)/\* cffi: end \*/", text, re.DOTALL))
    return declared.replace("extern const ", "extern ")  # cffi reads no constant from a loaded library
