"""Viewers of policies: films, a browser page, and MuJoCo's own window."""
