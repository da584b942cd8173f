"""The benchmarks of a GPU."""
