"""The training loop, and what it writes: metrics and checkpoints."""
