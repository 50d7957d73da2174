"""Recorded motion: file formats, skeletons, and how a character takes them over."""
