"""Scripts that measure and write result pages; not installed."""
