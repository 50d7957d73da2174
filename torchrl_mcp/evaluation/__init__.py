"""Evaluates policies: returns of episodes, tracking of every reference motion, and diagnostics of gates and options."""
