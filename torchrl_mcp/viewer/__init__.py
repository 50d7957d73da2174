"""Viewers of policies: films, a browser page, and MuJoCo's own window."""

import tensordict  # noqa: F401 - before mujoco, see envs/__init__.py
