"""Tasks: one class in one file each, read from top to bottom, over rewards that are pure functions."""
