"""The controller in C99, and what builds it (firmware/README.md)."""
