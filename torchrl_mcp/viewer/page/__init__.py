"""Writes a policy as a web page, on which the reader's browser computes physics, networks and pictures."""
