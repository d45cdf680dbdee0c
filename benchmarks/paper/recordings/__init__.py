"""Times that real episodes and real steps took, made by `python -m benchmarks.paper.record`."""
