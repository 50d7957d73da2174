"""Draws the paper's figures from run folders and policies, without changing matplotlib's global state."""

from torchrl_mcp.analysis.curves import Curve, draw_curves, learning_curves, write_curves
from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.analysis.holdout import (
    Trajectories,
    draw_trajectories,
    play_directions,
)
from torchrl_mcp.training.run_folder import read_metrics

__all__ = [
    "Curve",
    "Trajectories",
    "draw_curves",
    "draw_trajectories",
    "learning_curves",
    "play_directions",
    "read_metrics",
    "save_figure",
    "write_curves",
]
