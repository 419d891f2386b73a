"""A file a study, run by its name: `python -m benchmarks NAME`."""
