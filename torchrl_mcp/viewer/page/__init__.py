"""A policy as a web page that runs in the reader's browser: physics, networks and pictures."""
