"""The training loop, with its trajectory sources, metrics and checkpoints."""
