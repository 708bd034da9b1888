"""The controller in C99, and its build (firmware/README.md)."""
