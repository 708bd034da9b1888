"""Quality metrics, BD-rate, peers, benchmarks."""
