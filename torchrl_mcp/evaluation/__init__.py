"""Evaluation: returns of episodes, tracking of each reference motion, and diagnostics of gates and options."""
