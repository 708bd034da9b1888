"""Text that others wrote, such as a controller, made fit to be shown: nothing in it acts on a terminal."""


def plain(text: str) -> str:
    """Return a text with an escape in place of each character that cannot be seen: controls, line ends, directions."""
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)
