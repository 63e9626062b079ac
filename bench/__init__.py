"""Benchmarks: validate against the reference, then time, and print the losses too."""
