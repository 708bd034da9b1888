"""The hardware-in-the-loop harness: measures a controller on its bench, reports, and compares with an earlier run.

pytest imports this package in every project, for the plugin, so it loads nothing.
"""
