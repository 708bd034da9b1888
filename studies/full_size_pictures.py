"""A hook of the documentation site: every picture is a link to itself, which opens it in full size."""

import re
from typing import Any


def on_page_content(content: str, **_: Any) -> str:
    """Return the HTML of a page with its pictures in links."""
    return re.sub(r'<img [^>]*src="([^"]+)"[^>]*>', r'<a href="\1" title="Open in full size">\g<0></a>', content)
