"""Runs: built from configurations and trained in a folder each, singly or as benchmarks."""
