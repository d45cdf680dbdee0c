"""The experiments of the paper as one command: `python -m benchmarks.paper --help`."""
