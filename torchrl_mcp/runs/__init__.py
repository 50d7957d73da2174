"""Runs: built from configurations, trained in folders of their own, alone or as benchmarks of many."""
