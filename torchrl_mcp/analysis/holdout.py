"""Records and draws trajectories by target direction, as in Figure 5 (right)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_mcp.analysis.figures import DIRECTIONS, FAINT, INK, new_figure
from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.envs.rotations import unit_vector
from torchrl_mcp.evaluation.rollout import evaluate

QUARTERS = {"0": 0.0, "π/2": math.pi / 2, "π": math.pi, "3π/2": 1.5 * math.pi}


@dataclass(frozen=True)
class Trajectories:
    """Trajectories of episodes, with their target directions.

    Attributes:
        directions: Target directions in radians, from +x towards +y, ``(N,)``.
        positions: Horizontal position of the root in metres, ``(T, N, 2)``; NaN from the end of an episode on.
    """

    directions: NDArray[np.float64]
    positions: NDArray[np.float64]


def play_directions(
    policy: TensorDictModuleBase, env: CharacterEnv, directions: Tensor, *, deterministic: bool = True
) -> Trajectories:
    """Play one episode per direction; these directions replace the random directions of the environment.

    Args:
        policy: From ``observation`` and ``goal`` to ``action``.
        env: Environments whose ``goal`` is the (cos, sin) of a direction, batch size ``[N]``.
        directions: Target directions in radians, ``(N,)``.
        deterministic: Play the deterministic action instead of a sample.

    Raises:
        ValueError: If the number of directions differs from the number of environments.
    """
    if directions.shape != env.batch_size:
        raise ValueError(
            f"directions must have one value per environment, {tuple(env.batch_size)}, not shape "
            f"{tuple(directions.shape)}"
        )
    env.reset()
    start = env.get_state()
    start["goal"] = unit_vector(directions).to(start["goal"].dtype)
    outcome = evaluate(policy, env, deterministic=deterministic, start=start, positions=env.root_positions)
    assert outcome.positions is not None
    return Trajectories(directions.numpy().astype(np.float64), outcome.positions.numpy())


def draw_trajectories(panels: Mapping[str, Trajectories]) -> Figure:
    """Draw trajectories, one panel per title, on a common scale in metres.

    The colour of a path stands for its target direction, which a mark of the same colour on the outer ring shows. A
    perfect path is a ray towards its mark.
    """
    rings = _rings(max(_greatest_distance(panel) for panel in panels.values()))
    figure = new_figure(3.3 * len(panels), 4.0)
    for column, (title, trajectories) in enumerate(panels.items(), start=1):
        axes = figure.add_subplot(1, len(panels), column)
        _draw_compass(axes, rings)
        _draw_paths(axes, trajectories, 1.06 * rings[-1])
        axes.set_title(title, fontsize=11, color=INK)
    figure.supxlabel(f"rings: {rings[0]:g} m apart; marks: target directions", fontsize=9, color=INK)
    return figure


def _greatest_distance(trajectories: Trajectories) -> float:
    """Return the greatest distance from the origin, in metres."""
    return float(np.nanmax(np.linalg.norm(trajectories.positions, axis=-1), initial=0.0))


def _rings(reach: float) -> Sequence[float]:
    """Return round, equally spaced distances in metres, up to at least ``reach``."""
    ticks = MaxNLocator(nbins=3, steps=[1, 2, 4, 5, 10]).tick_values(0.0, max(reach, 1e-3))
    return [float(tick) for tick in ticks if tick > 0]


def _draw_compass(axes: Axes, rings: Sequence[float]) -> None:
    """Draw rings of equal distance, and label the quarters around the outermost ring."""
    angle = np.linspace(0.0, 2 * math.pi, 361)
    for radius in rings:
        axes.plot(radius * np.cos(angle), radius * np.sin(angle), color=FAINT, linewidth=0.8, zorder=0)
    for label, at in QUARTERS.items():
        x, y = 1.2 * rings[-1] * math.cos(at), 1.2 * rings[-1] * math.sin(at)
        axes.annotate(label, (x, y), ha="center", va="center", fontsize=9, color=INK)
    limit = 1.28 * rings[-1]
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def _draw_paths(axes: Axes, trajectories: Trajectories, rim: float) -> None:
    colours = DIRECTIONS(trajectories.directions / (2 * math.pi) % 1.0)
    for path, colour in zip(trajectories.positions.swapaxes(0, 1), colours, strict=True):
        axes.plot(*path.T, color=colour, linewidth=1.0, alpha=0.85, solid_capstyle="round")
    axes.scatter(
        rim * np.cos(trajectories.directions), rim * np.sin(trajectories.directions), s=26, c=colours, linewidths=0
    )
