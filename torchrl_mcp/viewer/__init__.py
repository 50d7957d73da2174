"""Policies to look at: in films, in a browser, and in MuJoCo's own window."""
