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
    Period,
    Positive,
    Range,
    Seed,
    Share,
    Text,
    Whole,
)


class Stage(TypedDict):
    """``stage``."""

    gamma: Discount


class Character(TypedDict):
    """``character``."""

    action_std: Positive
    motion_starts: NotNegative
    near_objects: Range


class Method(TypedDict):
    """``method``; ``paper`` has step sizes by stage and character."""

    paper: Mapping[str, Count | Mapping[str, Mapping[str, Positive]]]
    standard: Mapping[str, Count | Text]


class Task(TypedDict):
    """``task``, without the groups of arguments of its environments, which :func:`.settings_of` adds."""

    curriculum: Curriculum
    directions: Mapping[str, Range]
    lengths: Mapping[str, Count]
    logits_std: Positive
    near: Range
    near_objects: Range


class StepSize(TypedDict):
    """``step_size``."""

    actor: Positive
    max: Positive
    critic: Positive
    target_kl: Positive
    inputs: Period


class Objective(TypedDict):
    """``objective``, or its part for one stage."""

    max_grad_norm: Positive | None
    pretrain: "Objective"
    transfer: "Objective"


class Transfer(TypedDict):
    """``transfer``."""

    keep: Names
    freeze: Names
    goal_entry: Text | None
    restart_noise: bool


class Evaluation(TypedDict):
    """``evaluation``, without the arguments of the environments."""

    episodes: Whole
    seed: Seed


class Exploration(TypedDict):
    """``exploration``."""

    action_noise: bool
    bound_coeff: NotNegative
    latent_std: Positive | None
    learned_logits_std: Positive | None


class CurriculumChoice(TypedDict):
    """``curriculum``."""

    aids: Curriculum | None


class Primitives(TypedDict):
    """``primitives``."""

    initial_std: Positive


class Physics(TypedDict):
    """``physics``."""

    on_device: bool


class Hierarchy(TypedDict):
    """A stage of ``hierarchy``."""

    batch_factor: Count


class Goal(TypedDict):
    """An entry of ``goal``."""

    blind: Mapping[str, bool]
    keep: Names


class Demo(TypedDict):
    """``demo``."""

    minutes: Positive
    seconds: Positive


class RunSettings(TypedDict):
    """All settings of a run. A group that is not declared as optional must be in every configuration."""

    task: Task
    stage: Stage
    character: Character
    method: Method
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
    hierarchy: Mapping[str, Hierarchy] | None
    goal: Mapping[str, Goal] | None
    budget: Mapping[str, Count | Mapping[str, Count]] | None
    demo: Demo | None

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
    clip_epsilon: Positive
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

    clip_epsilon: Positive
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
