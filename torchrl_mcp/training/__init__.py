"""The training loop, its trajectory sources, metrics and checkpoints."""
