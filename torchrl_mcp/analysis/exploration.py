"""Measures and draws the paths of characters that explore at random, as in Figure 6."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_mcp.analysis.figures import COLOURS, FAINT, GRID, INK, bare, new_figure
from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.evaluation.rollout import evaluate
from torchrl_mcp.methods.actor import Explorer

Array = NDArray[np.float64]

UPRIGHT = COLOURS[0]
FALLEN = COLOURS[1]

SPACING = 0.2
"""Seconds between the positions of a path in a table."""


@dataclass(frozen=True)
class Exploration:
    """Paths of characters from a common initial state.

    Attributes:
        positions: Horizontal position of the root relative to its start in metres, ``(T + 1, N, 2)``; NaN after the
            end of the episode.
        ended: Whether each character fell before the time limit, ``(N,)``.
        timestep: Seconds between two positions.
    """

    positions: Array
    ended: NDArray[np.bool_]
    timestep: float

    @property
    def seconds(self) -> Array:
        """Seconds for which each character stayed upright, ``(N,)``."""
        steps = np.isfinite(self.positions[..., 0]).sum(0) - 1
        # One more step, because the position after the last step of an episode is not recorded.
        return (steps + 1) * self.timestep


def action_noise(action_dim: int, *, std: float, generator: torch.Generator) -> Explorer:
    """Return an explorer that plays Gaussian noise around action 0, which is the rest pose under PD control.

    Args:
        action_dim: Size of the action, ``A``.
        std: Standard deviation of the noise, in action units.
        generator: Source of randomness.
    """
    return lambda state: std * torch.randn(len(state), action_dim, generator=generator, device=generator.device)


def explore(
    explorer: Explorer, normaliser: Callable[[Tensor], Tensor], env: CharacterEnv, start: TensorDictBase
) -> Exploration:
    """Play one episode in each environment, in which the explorer acts.

    Args:
        explorer: From normalised states to actions.
        normaliser: From observed states to normalised states.
        env: Environments whose episodes end with a fall or at the time limit.
        start: Common initial state.
    """
    policy = TensorDictModule(
        lambda observation: explorer(normaliser(observation)), in_keys=["observation"], out_keys=["action"]
    )
    outcome = evaluate(policy, env, start=start, positions=env.root_positions)
    assert outcome.positions is not None
    origin = start["qpos"][:, :2]
    positions = torch.cat([origin.unsqueeze(0), outcome.positions]) - origin
    return Exploration(positions.numpy(), outcome.terminated.numpy(), env.control_timestep)


def path_statistics(exploration: Exploration) -> dict[str, float]:
    """Return measures of the extent of exploration.

    ``trajectories`` is the number of characters, ``upright`` the share of characters that did not fall, ``seconds`` the
    median time until the fall or the time limit, ``distance`` the median of the greatest distance from the origin in
    metres, and ``spread`` the circular variance of the final directions from the origin: 0 if all directions are the
    same, 1 if they are uniform.
    """
    distances = np.linalg.norm(exploration.positions, axis=-1)
    angles = np.arctan2(*_last(exploration.positions).T[::-1])
    return {
        "trajectories": len(exploration.ended),
        "upright": float(1 - exploration.ended.mean()),
        "seconds": float(np.median(exploration.seconds)),
        "distance": float(np.median(np.nanmax(distances, axis=0))),
        "spread": float(1 - np.abs(np.exp(1j * angles).mean())),
    }


def path_rows(exploration: Exploration) -> list[dict[str, float]]:
    """Return the position of every character, every :data:`SPACING` seconds until the end of its episode."""
    every = max(1, round(SPACING / exploration.timestep))
    return [
        {"trajectory": number, "seconds": round(step * exploration.timestep, 3), "x": round(x, 3), "y": round(y, 3)}
        for number, path in enumerate(exploration.positions.swapaxes(0, 1), start=1)
        for step, (x, y) in enumerate(path.tolist())
        if step % every == 0 and np.isfinite(x)
    ]


def draw_exploration(panels: Mapping[str, Exploration], *, title: str) -> Figure:
    """Draw paths from above, one panel per exploration, on a common scale; short paths are also shown enlarged.

    Args:
        panels: Explorations by name.
        title: Title of the figure.
    """
    points = np.concatenate([panel.positions.reshape(-1, 2) for panel in panels.values()])
    low = np.nanmin(points, 0)
    high = np.nanmax(points, 0)
    half = 0.53 * max((high - low).max(), 1e-3)
    limits = np.stack([(low + high) / 2 - half, (low + high) / 2 + half], -1)
    figure = new_figure(3.2 * len(panels), 4.5)
    figure.suptitle(title, fontsize=11, color=INK)
    grid = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for axes, (name, panel) in zip(grid, panels.items(), strict=True):
        _draw_paths(axes, panel)
        axes.set(xlim=limits[0], ylim=limits[1], aspect="equal")
        axes.set_title(f"{name}\n{_outcome(panel)}", fontsize=9, color=INK)
        axes.set_xlabel("forward (m)", fontsize=9)
        axes.grid(color=GRID)
        axes.set_axisbelow(True)
        bare(axes)
        if (reach := float(np.nanmax(np.abs(panel.positions)))) < 0.25 * half:
            _enlarge(axes, panel, 1.1 * reach)
    grid[0].set_ylabel("to the left (m)", fontsize=9)
    handles = [
        Line2D([], [], color=UPRIGHT, linewidth=1.4, label="upright to the end"),
        Line2D([], [], color=FALLEN, linewidth=1.4, marker="x", markersize=5, label="fell"),
        Line2D([], [], color=INK, linewidth=0, marker="o", markersize=4, label="start, facing forward"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9, labelcolor=INK)
    return figure


def _outcome(panel: Exploration) -> str:
    numbers = path_statistics(panel)
    return f"{numbers['upright']:.0%} upright, median {numbers['seconds']:.1f} s, reach {numbers['distance']:.1f} m"


def _draw_paths(axes: Axes, panel: Exploration, width: float = 1.0) -> None:
    for path, fell in zip(panel.positions.swapaxes(0, 1), panel.ended, strict=True):
        axes.plot(*path.T, color=FALLEN if fell else UPRIGHT, linewidth=width, alpha=0.75, solid_capstyle="round")
    x, y = _last(panel.positions)[panel.ended].T
    axes.scatter(x, y, s=12, marker="x", color=FALLEN, linewidths=0.8, zorder=3)
    axes.scatter(0.0, 0.0, s=14, color=INK, linewidths=0, zorder=4)


def _enlarge(axes: Axes, panel: Exploration, limit: float) -> None:
    inset = axes.inset_axes((0.6, 0.62, 0.38, 0.38))
    _draw_paths(inset, panel, 0.6)
    inset.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
    inset.locator_params(nbins=3)
    inset.tick_params(labelsize=7, labelcolor=INK, color=FAINT)
    inset.spines[:].set_color(FAINT)
    axes.indicate_inset_zoom(inset, edgecolor=INK, linewidth=0.8)


def _last(positions: Array) -> Array:
    """Return the last recorded position of every path, ``(N, 2)``."""
    last = np.isfinite(positions[..., 0]).sum(0) - 1
    return positions[last, np.arange(positions.shape[1])]
