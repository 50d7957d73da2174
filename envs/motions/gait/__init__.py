"""A generator of human walking."""
