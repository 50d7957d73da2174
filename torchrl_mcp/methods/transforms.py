"""Environment transforms that carry a policy's state from one step to the next.

TorchRL's collectors keep such a state if the environment has a spec for it, which these transforms add.
"""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform, TransformedEnv

from torchrl_mcp.values import Count


class TransformedCharacterEnv(TransformedEnv):
    """Environments with transforms, where the state of both can be set, saved and restored.

    TorchRL's own class saves only the state of the transforms, and does not pass a given state on to the environments.

    Example:
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.methods.transforms import OptionMemory, TransformedCharacterEnv
        >>> env = TransformedCharacterEnv(Heading("biped", num_envs=2, seed=0), OptionMemory())
        >>> sorted(env.state_dict())
        ['base_env', 'transform']
    """

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Return the state of the environments and of their transforms."""
        return {"base_env": self.base_env.state_dict(), "transform": self.transform.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any], **kwargs: Any) -> None:
        """Restore the state of :meth:`state_dict`; transforms keep nothing of episodes that do not go on."""
        self.base_env.load_state_dict(state_dict["base_env"])
        if self.base_env.resumes_episodes:
            self.transform.load_state_dict(state_dict["transform"])

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if not kwargs.get("set_state"):
            return super()._reset(tensordict, **kwargs)
        began = self.base_env._reset(tensordict, **kwargs)
        which = began.empty() if tensordict is None else tensordict.select("_reset", strict=False)
        return self.transform._reset(which, began)


class OptionMemory(Transform):
    """A transform that adds the previous step's option, ``held_option``, and its duration in steps, ``held_steps``.

    Both have the shape ``(N,)``. ``held_steps`` is 0 at the beginning of an episode, when there is no option yet. The
    policy writes ``option``, and ``begins``, which says whether it has chosen the option in this step, each ``(N,)``. A
    policy that writes neither keeps the option of the previous step.

    The memory is part of ``state_dict``. After loading, the next reset of all environments returns to the saved memory.

    Example:
        >>> import torch
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.methods.transforms import OptionMemory, TransformedCharacterEnv
        >>> env = TransformedCharacterEnv(Heading("biped", num_envs=2, seed=0), OptionMemory())
        >>> state = env.rand_action(env.reset())
        >>> state["option"], state["begins"] = torch.tensor([3, 5]), torch.tensor([True, True])
        >>> after = env.step(state)["next"]
        >>> after["held_option"], after["held_steps"]
        (tensor([3, 5]), tensor([1, 1]))
    """

    def __init__(self) -> None:
        super().__init__()
        self._held: dict[str, Tensor] = {}
        self._restored = False

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add ``held_option`` and ``held_steps``."""
        return _with_integers(observation_spec, "held_option", "held_steps")

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return the options and their durations."""
        return {key: value.clone() for key, value in self._held.items()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the state of :meth:`get_extra_state`."""
        self._held = {key: value.clone() for key, value in state.items()}
        self._restored = True

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        previous_option = tensordict["held_option"]
        steps = tensordict["held_steps"]
        begins = tensordict.get("begins", torch.zeros_like(steps, dtype=torch.bool))
        option = tensordict.get("option", previous_option)
        self._held = {"held_option": option.clone(), "held_steps": steps.masked_fill(begins, 0) + 1}
        return next_tensordict.update(self.get_extra_state())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        if mask is not None:
            self._held = {key: value.masked_fill(mask.squeeze(-1), 0) for key, value in self._held.items()}
        elif not self._restored:
            nothing = torch.zeros(tensordict_reset.batch_size, dtype=torch.int64, device=tensordict_reset.device)
            self._held = {"held_option": nothing, "held_steps": nothing}
        self._restored = False
        return tensordict_reset.update(self.get_extra_state())


class ClipAsOption(Transform):
    """A transform that adds the index of the reference motion as ``option``, so that each option imitates one clip.

    Environments of other libraries have numbered goals in place of clips: ``goal_number``, ``(N,)``, one of
    ``num_goals``.

    Args:
        num_options: Number of options, which is the number of reference motions or goals.

    Raises:
        ValueError: If the environment has another number of reference motions or goals.

    Reference:
        Peng et al., *MCP*, NeurIPS 2019, Section E.4. https://arxiv.org/abs/1905.09808
    """

    def __init__(self, num_options: Count) -> None:
        super().__init__()
        self.num_options = num_options

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add ``option``."""
        skills = getattr(self.parent, "num_goals", 0) or len(getattr(self.parent, "library", ()))
        if skills != self.num_options:
            raise ValueError(
                f"num_primitives={self.num_options} must be the number of reference motions, which is {skills}: pass "
                "this number as num_primitives, or pre-train with task=imitation and as many motions, such as "
                "motions=turning, or in an environment with as many goals that observes the number of its goal "
                "(goal_number)"
            )
        return _with_integers(observation_spec, "option")

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        clip = next_tensordict.get("goal_number", None)
        return next_tensordict.set("option", self.parent.episode["clip"].clone() if clip is None else clip.clone())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)


def _with_integers(spec: TensorSpec, *names: str) -> TensorSpec:
    """Return the spec with an entry for each name, of one integer per environment."""
    if not isinstance(spec, Composite):
        raise TypeError(f"the environment observes {spec}, which has no names: pass one whose spec is a Composite")
    for name in names:
        spec[name] = Unbounded(shape=spec.shape, device=spec.device, dtype=torch.int64)
    return spec
