"""The hardware-in-the-loop harness: a pytest plugin, measurements of a controller on its bench, their report."""
