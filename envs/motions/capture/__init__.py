"""Recorded motion: file formats, skeletons, and retargeting to characters."""
