"""The `vibrocast` command; only this package knows click."""
