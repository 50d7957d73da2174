"""Records films, weights of primitives and learning curves during training."""

import copy
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import torch
from matplotlib.figure import Figure
from PIL import Image
from tensordict.nn import TensorDictModuleBase
from torchrl.record.loggers.common import Logger
from torchrl.record.loggers.mlflow import MLFlowLogger
from torchrl.record.loggers.tensorboard import TensorboardLogger
from torchrl.record.loggers.wandb import WandbLogger

from torchrl_mcp.analysis.curves import draw_curves, learning_curves
from torchrl_mcp.analysis.figures import bare, colours, new_figure
from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.methods.transforms import TransformedCharacterEnv
from torchrl_mcp.training.run_folder import NORMALISED_RETURN, read_metrics
from torchrl_mcp.viewer.film import save_film
from torchrl_mcp.viewer.player import Player, Weights

FOLDER = "recordings"
"""Subfolder of a run folder for recordings."""


class Recorder:
    """Saves a film, the weights of the primitives in the film, and the learning curve, every ``interval`` iterations.

    Training calls a recorder in every iteration, like a logger. Recorders use none of the run's random numbers, so that
    a run gives the same numbers with and without recordings.

    Args:
        folder: The run folder; pictures go into its subfolder ``recordings/``.
        policy: The policy in training.
        make_env: Makes the environment in which the policy plays.
        loggers: TorchRL loggers; TensorBoard, W&B and MLflow also receive the pictures.
        num_options: Number of options of the policy, 0 without options.
        interval: Iterations between recordings.
        seconds: Duration of the film in seconds.
        width: Width of the film in pixels.
        height: Height of the film in pixels.

    Raises:
        ValueError: If ``interval`` is less than 1.
    """

    def __init__(
        self,
        folder: Path,
        policy: TensorDictModuleBase,
        make_env: Callable[[], CharacterEnv | TransformedCharacterEnv],
        loggers: Sequence[Logger],
        *,
        num_options: int,
        interval: int,
        seconds: float = 6.0,
        width: int = 320,
        height: int = 240,
    ) -> None:
        if interval < 1:
            raise ValueError(f"recorder.interval={interval} must be at least 1, or null for no recordings")
        self._folder = folder
        self._policy = policy
        self._make_env = make_env
        self._loggers = loggers
        self._num_options = num_options
        self._interval = interval
        self._seconds = seconds
        self._width = width
        self._height = height

    def log_metrics(self, metrics: Mapping[str, float], step: int) -> None:
        """Save a recording if one is due.

        Args:
            metrics: Metrics of an iteration, including its number as ``iteration``.
            step: Environment steps so far.
        """
        if metrics["iteration"] % self._interval:
            return
        with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
            for name, path in self._record(step):
                for logger in self._loggers:
                    show(logger, name, path, step)

    def _record(self, step: int) -> Iterator[tuple[str, Path]]:
        """Write each picture, and yield its name and file."""
        policy = copy.deepcopy(self._policy).cpu()
        recordings = self._folder / FOLDER
        recordings.mkdir(exist_ok=True)
        film = recordings / f"film-{step:012d}.gif"
        gates = recordings / f"gates-{step:012d}.png"
        curve = recordings / f"curve-{step:012d}.png"
        try:
            save_film(
                policy,
                self._make_env(),
                film,
                seconds=self._seconds,
                width=self._width,
                height=self._height,
                num_options=self._num_options,
            )
            yield "film", film
        except RuntimeError as error:  # without OpenGL, weights and curves can still be drawn
            warnings.warn(f"no film: {error}", stacklevel=2)
        if figure := self._weights(policy):
            figure.savefig(gates, dpi=100)
            yield "gates", gates
        if any(math.isfinite(row[NORMALISED_RETURN]) for row in read_metrics(self._folder)):
            draw_curves(learning_curves({"this run": [self._folder]})).savefig(curve, dpi=100)
            yield "curve", curve

    def _weights(self, policy: TensorDictModuleBase) -> Figure | None:
        """Draw the weights of the primitives during the film, or return None for a policy without weights."""
        player = Player(policy, self._make_env(), num_options=self._num_options)
        weights_of_steps: list[Weights | None] = []
        for _ in range(round(self._seconds / player.env.control_timestep)):
            player.step()
            weights_of_steps.append(player.weights)
        values = [weights.values for weights in weights_of_steps if weights is not None]
        return draw_weights(torch.tensor(values), player.env.control_timestep) if values else None


def draw_weights(values: torch.Tensor, timestep: float) -> Figure:
    """Draw weights over time, a line for each primitive.

    Args:
        values: Weights, shape ``(T, K)``.
        timestep: Seconds between rows.
    """
    figure = new_figure(6.0, 3.0)
    axes = figure.add_subplot()
    times = timestep * torch.arange(1, len(values) + 1)
    for number, (line, colour) in enumerate(zip(values.T, colours(values.shape[1]), strict=True), start=1):
        axes.plot(times.numpy(), line.numpy(), color=colour, linewidth=1.5, label=str(number))
    axes.set(xlabel="seconds", ylabel="weight", ylim=(-0.02, 1.02))
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, title="primitive", fontsize=8)
    bare(axes)
    return figure


def show(logger: Logger, name: str, path: Path, step: int) -> None:
    """Send a picture or an animated GIF to a logger.

    TorchRL's ``log_video`` would need further libraries, because it encodes tensors as films.

    Args:
        logger: The logger; loggers other than TensorBoard, W&B and MLflow are ignored.
        name: Name of the picture.
        path: The file, ``.png`` or ``.gif``.
        step: Environment steps so far.
    """
    if isinstance(logger, TensorboardLogger):
        from tensorboard.compat.proto.summary_pb2 import Summary

        with Image.open(path) as picture:
            width, height = picture.size
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=path.read_bytes())
        summary = Summary(value=[Summary.Value(tag=name, image=image)])
        logger.experiment._get_file_writer().add_summary(summary, step)
    elif isinstance(logger, WandbLogger):
        import wandb

        moving = path.suffix == ".gif"
        media = wandb.Video(str(path), format="gif") if moving else wandb.Image(str(path))
        logger.log_scalar(name, media, step=step)
    elif isinstance(logger, MLFlowLogger):
        import mlflow

        mlflow.log_artifact(str(path), FOLDER)
