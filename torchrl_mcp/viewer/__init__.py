"""Viewers of policies: films, web pages, and the window of MuJoCo."""

import tensordict  # noqa: F401 - before mujoco, see envs/__init__.py
