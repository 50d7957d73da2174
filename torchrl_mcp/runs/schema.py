"""Types of the settings that are not arguments of a class or function: those of ``conf/train.yaml`` and its groups.

Groups with ``_target_`` are not declared here, because :mod:`.arguments` reads the types of their settings from the
signature of the target.
"""

from collections.abc import Mapping
from typing import Any, Literal, TypedDict

import torch
import torchrl.objectives

from torchrl_mcp.envs.curriculum import Curriculum
from torchrl_mcp.envs.tasks.transport import Positions
from torchrl_mcp.training.update import PPOSettings
from torchrl_mcp.values import (
    Count,
    Discount,
    Finite,
    Names,
    NotNegative,
    Positive,
    PositiveOrInfinite,
    Probability,
    Range,
    Seed,
    Share,
    Text,
    Whole,
)


class Stage(TypedDict):
    """The group ``stage``."""

    gamma: Discount


class Character(TypedDict):
    """The group ``character``."""

    action_std: Positive
    motion_starts: NotNegative
    near_objects: Range


class Task(TypedDict):
    """The group ``task``, without the groups of arguments of its environments."""

    curriculum: Curriculum
    directions: Mapping[str, Range]
    lengths: Mapping[str, Count]
    logits_std: Positive
    near: Range
    near_objects: Range


class StepSize(TypedDict):
    """The group ``step_size``."""

    actor: Positive
    max: Positive
    critic: Positive
    target_kl: Positive
    inputs: PositiveOrInfinite


class Objective(TypedDict):
    """The group ``objective``, or its part for one stage."""

    max_grad_norm: Positive | None
    pretrain: "Objective"
    transfer: "Objective"


class Transfer(TypedDict):
    """The group ``transfer``."""

    keep: Names
    freeze: Names
    goal_entry: Text | None
    restart_noise: bool


class Evaluation(TypedDict):
    """The group ``evaluation``, without the arguments of the environments."""

    episodes: Whole
    seed: Seed


class Exploration(TypedDict):
    """The group ``exploration``."""

    action_noise: bool
    bound_coeff: NotNegative
    latent_std: Positive | None
    learned_logits_std: Positive | None
    min_latent_std: NotNegative


class CurriculumChoice(TypedDict):
    """The group ``curriculum``."""

    aids: Curriculum | None


class Primitives(TypedDict):
    """The group ``primitives``."""

    initial_std: Positive


class Physics(TypedDict):
    """The group ``physics``."""

    on_device: bool


class RunSettings(TypedDict):
    """All settings of a run. A group that is not declared as optional must be in every configuration.

    Tables from which a method, a stage or a task chooses a setting, such as ``budget``, are not declared, because the
    chosen setting is checked.
    """

    task: Task
    stage: Stage
    character: Character
    method: Mapping[str, Any]
    training: PPOSettings
    step_size: StepSize
    evaluation: Evaluation
    optimizer: Mapping[str, Any]
    objective: Objective
    transfer: Transfer
    exploration: Exploration | None
    curriculum: CurriculumChoice | None
    primitives: Primitives | None
    physics: Physics | None

    seed: Seed
    device: Text
    autocast: bool | Literal["auto"]
    num_threads: Whole
    torch_threads: Count | None
    pretrained: Text | None
    resume: Text | None
    run_root: Text
    run_dir: Text
    checkpoint_interval: Count
    keep_checkpoints: Count
    progress_bar: bool
    record_interval: Count | None

    width: Positive
    kept_width: Positive
    std_gain: Positive
    action_std: Positive
    learned_std: bool
    clip_epsilon: Probability  # PPO takes the logarithm of 1 - clip_epsilon
    entropy_coeff: NotNegative
    lmbda: Share
    epsilon: Share
    goal_positions: Positions
    waypoint: bool
    batch_factor: Count
    num_primitives: Count
    num_options: Count
    latent_dim: Count
    steps_per_choice: Count


class Optimizer(TypedDict):
    """Arguments of ``torch.optim.Adam`` and ``torch.optim.SGD``."""

    lr: Positive
    momentum: Share
    fused: bool


class ClipPPOLoss(TypedDict):
    """Arguments of TorchRL's ``ClipPPOLoss`` and of its subclasses."""

    clip_epsilon: Probability  # PPO takes the logarithm of 1 - clip_epsilon
    entropy_bonus: bool
    functional: bool


class KLAdaptiveLR(TypedDict):
    """Arguments of TorchRL's ``KLAdaptiveLR``."""

    target_kl: Positive
    min_lr: Positive
    max_lr: Positive


class Softmax(TypedDict):
    """Arguments of ``torch.nn.Softmax``."""

    dim: Finite


OTHER_LIBRARIES: Mapping[type, type] = {
    torch.optim.Adam: Optimizer,
    torch.optim.SGD: Optimizer,
    torchrl.objectives.ClipPPOLoss: ClipPPOLoss,
    torchrl.objectives.KLAdaptiveLR: KLAdaptiveLR,
    torch.nn.Softmax: Softmax,
}
"""Types of arguments of classes of other libraries."""
