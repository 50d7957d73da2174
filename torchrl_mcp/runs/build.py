"""Builds environments, agent and trainer from a configuration, with Hydra's ``instantiate``."""

import inspect
import os
import sys
from collections.abc import Collection, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import torch
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import Compose
from torchrl.record.loggers.common import Logger

from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.envs.physics.engines import require_engine
from torchrl_mcp.methods.actor import Actor
from torchrl_mcp.methods.options import OptionActor
from torchrl_mcp.methods.transforms import TransformedCharacterEnv
from torchrl_mcp.modules.gaussian import restart_noise
from torchrl_mcp.runs import places, validation
from torchrl_mcp.runs.trust import require_trusted, targets
from torchrl_mcp.training import checkpoint
from torchrl_mcp.training.collectors import TrajectorySource
from torchrl_mcp.training.metrics import MetricsWriter
from torchrl_mcp.training.trainer import Trainer
from torchrl_mcp.training.transfer import FrozenParts, require_frozen_input, require_parts


@dataclass(frozen=True)
class Agent:
    """A method's networks for the sizes of an environment."""

    parts: nn.ModuleDict
    actor: Actor
    critic: TensorDictModuleBase
    frozen: FrozenParts

    @property
    def spare_parts(self) -> set[str]:
        """Names of the parts that act in no state: the critic, unless its values choose the option."""
        acting = {id(parameter) for parameter in self.actor.policy.parameters()}
        return {"critic"} if acting.isdisjoint(map(id, self.parts["critic"].parameters())) else set()


def require_valid(cfg: DictConfig) -> None:
    """Check the values of all settings.

    Raises:
        ValueError: As :func:`torchrl_mcp.runs.validation.require_valid`, or if a setting refers to one that is missing.
    """
    try:
        config = _plain(cfg)
    except OmegaConfBaseException as error:
        raise ValueError(f"the settings contradict each other: {str(error).partition(chr(10))[0]}") from error
    validation.require_valid(config)


def require_environment(cfg: DictConfig) -> None:
    """Check that there is an environment for the configured task, stage and character.

    Raises:
        ValueError: If there is none, or this version lacks a class that the configuration names.
    """
    task, character = cfg.task.name, cfg.character.name
    if module := cfg.character.get("module"):
        _import(module, character)
    if cfg.stage.name not in cfg.task:
        raise ValueError(
            f"task={task} has no stage={cfg.stage.name}: pre-train with task=imitation, and transfer to "
            f"task={task} with stage=transfer and pretrained=<folder of the pre-training>, or pretrained=builtin"
        )
    # Import everything that is named: importing a user's motions may register the user's character.
    environment, *_ = [get_object(name) for name in named(cfg.task[cfg.stage.name])]
    able: tuple[str, ...] = getattr(environment, "characters", tuple)()
    if able and character not in able:
        known = " or ".join(able)
        raise ValueError(f"no environment has task={task} with character={character}: pass character={known}")


def require_files(cfg: DictConfig, task: DictConfig) -> None:
    """Check that the files of a task's environments exist.

    Args:
        cfg: Configuration of the run.
        task: Configuration of the environments.

    Raises:
        ValueError: If one is missing, with the settings that give a new place.
    """
    lost = {value: name for name, value in places.settings(_plain(task)) if not Path(value).exists()}
    if not lost:
        return
    named = {value: name for name, value in places.outside(_plain(cfg)).items()}
    value, argument = next(iter(lost.items()))
    name = named.get(value, f"task.{cfg.stage.name}.{argument}")
    raise ValueError(
        f"{name}={value} does not exist: put it back, or give its new place by {name}=PATH, with resume= by "
        f"+{name}=PATH, and to torchrl-mcp-play and torchrl-mcp-evaluate by --task {argument}=PATH"
    )


def require_equipment(cfg: DictConfig) -> None:
    """Check that this machine has the configured device and logger.

    Raises:
        ValueError: If one is missing.
    """
    try:
        kind_of_device = torch.device(cfg.device).type
    except RuntimeError as error:
        raise ValueError(f"torch does not know device={cfg.device}: pass cpu or cuda") from error
    if kind_of_device == "mps":
        raise ValueError(f"device={cfg.device} has no float64, which normalisers count in: pass cpu or cuda")
    if kind_of_device == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            f"device={cfg.device}: torch {torch.__version__} finds no CUDA device. Pass device=cpu, or install a CUDA "
            "build of torch on a machine with a GPU"
        )
    if _on_device(cfg):
        require_engine(cfg.physics, torch.device(cfg.device))
        if "num_workers" in cfg.collector:
            raise ValueError("physics=warp simulates all environments at once, without workers: pass collector=local")
    kind = cfg.logger.logger_type if cfg.logger else "csv"
    if kind != "csv" and find_spec(kind) is None:
        raise ValueError(f"logger={kind} needs {kind}: pip install 'torchrl-mcp[{kind}]', or choose logger=tensorboard")


def require_known(config: Mapping[str, Any], source: Path) -> None:
    """Check that all classes and functions in a run's configuration exist and may be called.

    Args:
        config: The configuration.
        source: The file of the configuration.

    Raises:
        ValueError: If one is missing or not trusted.
    """
    names = list(targets(config))
    # Importing the library's own modules runs no other code, so it is safe before the check of trust.
    if lost := [name for name in names if name.startswith("torchrl_mcp.") and not _exists(name)]:
        raise ValueError(
            f"{source} is of another version of torchrl-mcp: this version has no {lost[0]}. "
            "Use the version that wrote it, whose commit is in the run folder's origin.json, or train again"
        )
    require_trusted(config, source)
    if lost := [name for name in names if not _exists(name)]:
        raise ValueError(
            f"{source} names {lost[0]}, which Python does not find: if the module is yours, run the command in its "
            "folder, or add its folder to PYTHONPATH"
        )


def named(cfg: DictConfig) -> list[str]:
    """Return the names of all classes and functions that a configuration calls."""
    return list(targets(_plain(cfg)))


def make_env(cfg: DictConfig, *, num_envs: int, seed: int, **kwargs: Any) -> CharacterEnv | TransformedCharacterEnv:
    """Return the environments of the configured task and stage, with the transforms that the method needs, if any.

    Raises:
        ValueError: As :func:`require_environment`.
    """
    require_environment(cfg)
    task, others = _with_parts(cfg.task[cfg.stage.name], kwargs)
    _require_arguments(task["_target_"], others)
    require_files(cfg, task)
    arguments = {"num_threads": cfg.num_threads, **others}
    env = instantiate(task)(num_envs=num_envs, seed=seed, **arguments)
    if not (transforms := instantiate(cfg.get("transforms", []))):
        return env
    return TransformedCharacterEnv(env, Compose(*transforms))


def make_agent(cfg: DictConfig, env: CharacterEnv, pretrained: Path | None = None) -> Agent:
    """Return the agent of the configured method.

    If the checkpoint file ``pretrained`` is given, the parts that transfer keeps are loaded from it; in pre-training,
    all parts in the file are.

    Raises:
        ValueError: If the parts that transfer keeps or freezes are unknown or do not go together, or the file does not
            fit.
    """
    sizes = {key: env.observation_spec[key].shape[-1] for key in ("observation", "goal")}
    parts = instantiate(cfg.parts)(sizes["observation"], sizes["goal"], env.action_spec.shape[-1])
    names: Sequence[str] = ()
    if cfg.stage.name == "transfer":
        require_parts(parts, cfg.transfer.keep, "transfer.keep")
        if pretrained is not None and cfg.transfer.keep:
            checkpoint.load_parts(parts, cfg.transfer.keep, pretrained)
            if cfg.transfer.get("restart_noise"):
                restart_noise(parts, cfg.action_std)
        names = cfg.transfer.freeze
        require_frozen_input(parts, cfg.transfer.keep, names)
    frozen = FrozenParts(parts, names)
    actor = instantiate(cfg.actor)(parts, frozen=names)
    critic = instantiate(cfg.critic)(parts, sizes["observation"], sizes["goal"])
    if cfg.stage.name == "pretrain" and pretrained is not None:
        checkpoint.load_agent(parts, pretrained)
    parts.to(cfg.device)
    return Agent(parts, actor, critic, frozen)


def make_source(cfg: DictConfig) -> TrajectorySource:
    """Return the configured source of trajectories."""
    if _on_device(cfg):
        factory = partial(make_env, cfg, physics=cfg.physics, device=cfg.device)
    else:
        factory = partial(make_env, cfg, pin_memory=torch.device(cfg.device).type == "cuda")
    return instantiate(cfg.collector)(factory, num_envs=cfg.training.num_envs, seed=cfg.seed)


def make_trainer(cfg: DictConfig, agent: Agent, source: TrajectorySource, folder: Path) -> Trainer:
    """Return the trainer of an agent; ``cfg.autocast`` is true or false, as chosen by :func:`.precision.choose`.

    A method whose samples last for several steps, such as choices, sets ``batch_factor``: its batches are larger than
    ``training.frames_per_batch`` by this factor.
    """
    assert isinstance(cfg.autocast, bool)
    trainable = {
        "actor": [p for p in agent.actor.trained.parameters() if p.requires_grad],
        "critic": list(agent.parts["critic"].parameters()),
    }
    optimizers = {name: instantiate(cfg.optimizer[name])(p) for name, p in trainable.items() if p}
    loss = instantiate(cfg.objective.loss)(agent.actor.trained, None)
    loss.set_keys(action=agent.actor.sampled, sample_log_prob=agent.actor.log_prob)
    advantages = instantiate(cfg.objective.advantages)(agent.critic)
    if symmetry := instantiate(cfg.get("symmetry")):
        mirrors = nn.ModuleDict(source.env.mirrors()).to(cfg.device)
        if "advantages" in symmetry:
            advantages = symmetry["advantages"](advantages, agent.actor, mirrors)
        if "loss" in symmetry:
            loss = symmetry["loss"](loss, agent.actor, mirrors)
    training = {key: value for key, value in cfg.training.items() if key != "num_envs"}
    training["frames_per_batch"] *= cfg.get("batch_factor", 1)
    return Trainer(
        source=source,
        parts=agent.parts,
        actor=agent.actor,
        critic=agent.critic,
        losses={"actor": loss, "critic": instantiate(cfg.objective.value_loss)(agent.critic)},
        advantages=advantages,
        optimizers=optimizers,
        frozen=agent.frozen,
        metrics_writer=MetricsWriter(folder),
        checkpoints=checkpoint.rotation(folder, cfg.keep_checkpoints),
        config=stored(cfg),
        max_grad_norm=cfg.objective.max_grad_norm,
        step_size_schedule=instantiate(cfg.optimizer.schedule),
        autocast=cfg.autocast,
        device=cfg.device,
        checkpoint_interval=cfg.checkpoint_interval,
        progress_bar=cfg.progress_bar,
        **training,
    )


def make_loggers(cfg: DictConfig) -> list[Logger]:
    """Return the configured logger, if any."""
    # MLflow 3 writes to files, which need no server and stay in the run folder, only if this is set.
    os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
    return [instantiate(cfg.logger)] if cfg.logger else []


def make_recorders(cfg: DictConfig, actor: Actor, folder: Path, loggers: Sequence[Logger]) -> list[Any]:
    """Return the recorder of films, weights and learning curves, if one is configured."""
    if cfg.get("record_interval") is None:
        return []
    make_film_env = partial(make_env, cfg, num_envs=1, seed=cfg.evaluation.seed)
    num_options = actor.num_options if isinstance(actor, OptionActor) else 0
    return [instantiate(cfg.recorder)(folder, actor.policy, make_film_env, loggers, num_options=num_options)]


def compose_run(*overrides: str) -> DictConfig:
    """Return the configuration of ``torchrl-mcp-train`` with these arguments."""
    begun = GlobalHydra.instance().is_initialized()  # true on the command line
    with nullcontext() if begun else initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        return compose("train", list(overrides))


def launched() -> tuple[list[str], dict[str, str]]:
    """Return command line and choices of config groups, of the run that Hydra launched or of this process."""
    if not HydraConfig.initialized():
        return list(sys.argv), {}
    hydra = HydraConfig.get()
    made = hydra.runtime.choices.items()
    choices = {group: choice for group, choice in made if choice and not group.startswith("hydra/")}
    return ["torchrl-mcp-train", *hydra.overrides.task], choices


def arguments(name: str) -> dict[str, inspect.Parameter]:
    """Return the parameters of a class or function by its name, with those that a class passes on to its bases."""
    made = get_object(name)
    kinds = made.__mro__ if inspect.isclass(made) else ()
    found: dict[str, inspect.Parameter] = {}
    for maker in [vars(kind)["__init__"] for kind in kinds if "__init__" in vars(kind)] or [made]:
        parameters = inspect.signature(maker).parameters
        found = {**parameters, **found}
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
            break
    return found


def stored(cfg: DictConfig) -> dict[str, Any]:
    """Return a run's configuration as it is stored: resolved, and valid wherever the run folder is."""
    here = OmegaConf.merge(cfg, {"run_dir": places.HERE, "run_root": places.HERE})
    return places.stored(_plain(cast("DictConfig", here)))


def _plain(cfg: DictConfig) -> dict[str, Any]:
    """Return a configuration with all references resolved."""
    return cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True))


def _with_parts(task: DictConfig, arguments: Mapping[str, Any]) -> tuple[DictConfig, dict[str, Any]]:
    """Return a task's configuration and its other arguments, after setting arguments of the objects that it builds."""
    parts = {
        name: value
        for name, value in arguments.items()
        if isinstance(value, Mapping) and OmegaConf.is_dict(task.get(name)) and "_target_" in task[name]
    }
    merged = cast("DictConfig", OmegaConf.merge(task, parts)) if parts else task
    return merged, {name: value for name, value in arguments.items() if name not in parts}


def _require_arguments(name: str, given: Collection[str]) -> None:
    """Check that a task takes the arguments given, and list those that it takes."""
    if not inspect.isclass(get_object(name)):
        return
    taken = arguments(name)
    if unknown := [argument for argument in given if argument not in taken]:
        base = {*inspect.signature(CharacterEnv.__init__).parameters} - {
            "max_episode_steps"
        }  # what tasks set themselves
        listed = sorted({*taken} - base - {"kwargs", "character"})
        raise ValueError(f"the task has no argument {' and no '.join(unknown)}: it takes {', '.join(listed)}")


def _import(module: str, character: str) -> None:
    """Import the module that adds a character to the library's."""
    try:
        import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:
            raise
        raise ValueError(
            f"character={character} is in the module {module}, which Python does not find: call from the folder of "
            f"{module}.py, or add that to PYTHONPATH"
        ) from error


def _on_device(cfg: DictConfig) -> bool:
    """Return whether training episodes are simulated on the networks' device; older runs lack the setting."""
    return cfg.get("physics") == "warp"


def _exists(name: str) -> bool:
    try:
        get_object(name)
    except (ImportError, AttributeError, ValueError):
        return False
    return True
