"""Environments that begin the next episode by themselves and do not return the last observation of an episode."""

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_as_right
from torchrl.envs import Transform


class RepeatObservation(Transform):
    r"""Repeat the observation before the last step of an episode after this step.

    Some simulators, such as Isaac Lab, reset an environment in the step that ends its episode, and return the first
    observation of the next episode. TorchRL's ``IsaacLabWrapper`` moves this observation to the next episode and leaves
    NaN in its place. The last observation matters after a time limit, because the value of the state that it describes
    follows the last reward. With the repeated observation, :math:`V(s_T)` takes the place of :math:`V(s_{T+1})`, as in
    rsl_rl.

    The transform must be the last one of the environments, whose reset of ended environments must not reset them again.

    Reference:
        Schwarke et al., *RSL-RL: A Learning Library for Robotics Research*, 2025, https://arxiv.org/abs/2509.10771

    Example:
        >>> from torchrl.envs import GymEnv, SerialEnv, TransformedEnv
        >>> from torchrl_mcp.adapters.autoreset import RepeatObservation
        >>> env = TransformedEnv(SerialEnv(2, lambda: GymEnv("Pendulum-v1")), RepeatObservation())
        >>> env.rollout(3)["observation"].shape
        torch.Size([2, 3, 3])
    """

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        done = next_tensordict["done"]
        for key in self.parent.observation_spec.keys(True, True):
            observed = next_tensordict[key]
            next_tensordict[key] = torch.where(expand_as_right(done.squeeze(-1), observed), tensordict[key], observed)
        return next_tensordict
