"""The parts of C headers that cffi can parse."""

import re
from pathlib import Path


def cffi_declarations(folder: Path) -> str:
    """Return what stands between `/* cffi: begin */` and `/* cffi: end */` in a folder's headers."""
    text = "\n".join(path.read_text() for path in sorted(folder.glob("*.h")))
    return "\n".join(re.findall(r"/\* cffi: begin \*/(.*?)/\* cffi: end \*/", text, re.DOTALL))
