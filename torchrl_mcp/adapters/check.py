"""The check of the contract, which a training makes before it begins."""

import logging
from collections.abc import Iterator
from typing import Any

import torch
from torchrl import torchrl_logger
from torchrl.data import Bounded
from torchrl.envs import EnvBase, check_env_specs

from torchrl_mcp.adapters.contract import Environments

MEMBERS = sorted(name for name in vars(Environments) | Environments.__annotations__ if not name.startswith("_"))
"""Names of all members that the contract needs."""

REMEDY = "wrap the environment in torchrl_mcp.adapters.adapter.Adapter, which adds what is missing"


def require_contract(env: Any) -> None:
    """Check that environments satisfy :class:`~torchrl_mcp.adapters.contract.Environments`, without taking a step.

    Args:
        env: The environments.

    Raises:
        ValueError: If they do not. The message names the first thing that is missing.
    """
    if wrong := next(deviations(env), None):
        raise ValueError(f"{type(env).__name__} cannot be trained in, because {wrong}: {REMEDY}")


def require_specs(env: EnvBase) -> None:
    """Check that environments do what their specs say, by TorchRL's ``check_env_specs``.

    The environments are reset and take a few random steps, so do not pass those of the training.

    Args:
        env: The environments.

    Raises:
        ValueError: If they do not.
    """
    level = torchrl_logger.level
    torchrl_logger.setLevel(logging.ERROR)  # it also tells of success
    try:
        with torch.random.fork_rng(devices=[]):
            check_env_specs(env)
    except (AssertionError, RuntimeError, ValueError, KeyError) as error:  # what TorchRL raises of specs
        first = str(error).strip().partition("\n")[0]
        raise ValueError(f"{type(env).__name__} does not do what its specs say: {first}") from error
    finally:
        torchrl_logger.setLevel(level)


def deviations(env: Any) -> Iterator[str]:
    """Yield the deviations of environments from the contract that their specs and members show.

    Args:
        env: The environments.

    Yields:
        Clauses that follow "because".
    """
    if not isinstance(env, EnvBase):
        yield f"it is a {type(env).__name__} and no EnvBase of TorchRL"
        return
    if missing := [name for name in MEMBERS if not hasattr(env, name)]:
        yield f"it lacks {', '.join(missing)}"
        return
    if len(env.batch_size) != 1:
        yield f"its batch size is {list(env.batch_size)} and not [N], of N environments side by side"
        return
    keys = env.full_observation_spec.keys(True, True)
    yield from (f"it does not observe {key!r}" for key in ("observation", "goal", *env.metric_names) if key not in keys)
    for key in (key for key in ("observation", "goal") if key in keys):
        spec = env.observation_spec[key]
        if spec.ndim != 2 or not spec.dtype.is_floating_point:
            yield f"its {key} is {spec.dtype} of shape {tuple(spec.shape)} and not one vector of floats for each"
    yield from _deviations_of_action(env)
    if env.reward_keys != ["reward"] or not {"terminated", "truncated", "done"} <= {*env.done_keys}:
        ends = f"{env.reward_keys} and {env.done_keys}"
        yield f"its rewards and ends are {ends} and not reward, terminated, truncated and done"


def _deviations_of_action(env: EnvBase) -> Iterator[str]:
    if env.action_keys != ["action"]:
        yield f"it has the actions {env.action_keys} and not one called action"
        return
    spec = env.action_spec
    if spec.ndim != 2 or not isinstance(spec, Bounded) or not spec.dtype.is_floating_point:
        yield f"its action is {type(spec).__name__} of shape {tuple(spec.shape)} and not a vector with bounds"
