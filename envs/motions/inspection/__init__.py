"""Inspection of clips: measures, feasibility and pictures."""
