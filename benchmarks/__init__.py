"""Studies that measure what allanjax claims: `python -m benchmarks --list`."""
