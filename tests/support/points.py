"""Environments of other libraries that tests adapt: points on a line, by TorchRL and by Gymnasium."""

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

LENGTH = 7
"""Steps of an episode of the points of Gymnasium."""


PLACES = 7


class Point(gymnasium.Env):
    """A point that moves by its action, in [-2, 2], towards a place on a line; Gymnasium's goal-conditioned form."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode=None, reach=3.0):
        self.render_mode, self.reach = render_mode, reach
        box = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        keys = ("observation", "achieved_goal", "desired_goal")
        places = gymnasium.spaces.Discrete(PLACES)
        self.observation_space = gymnasium.spaces.Dict({**dict.fromkeys(keys, box), "number": places})
        self.action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32)

    def _observed(self):
        x, goal = np.array([self.x]), np.array([self.goal])
        number = int(PLACES * (self.goal + self.reach) / (2 * self.reach or 1))  # of seven places in a row
        steps = np.array([self.steps], dtype=float)
        return {"observation": steps, "achieved_goal": x, "desired_goal": goal, "number": number}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps, self.goal = 0.0, 0, self.np_random.uniform(-self.reach, self.reach)
        return self._observed(), {}

    def step(self, action):
        self.x += float(action[0])
        self.steps += 1
        near = abs(self.x - self.goal) < 0.5
        return self._observed(), -abs(self.x - self.goal), False, False, {"is_success": near, "x": self.x}

    def render(self):
        return np.full((8, 12, 3), self.steps, np.uint8)


gymnasium.register("Point-v0", entry_point=Point, max_episode_steps=LENGTH)


class Points(EnvBase):
    """TorchRL points that move by their action from -1 to 3, and end beyond 5; without a goal or a time limit."""

    batch_locked = True

    def __init__(self, num_envs=3, seed=None):
        super().__init__(batch_size=[num_envs])
        shape, one = self.batch_size, (num_envs, 1)
        self.observation_spec = Composite(
            place=Unbounded((num_envs, 2, 2)), far=Binary(1, shape=one, dtype=torch.bool), shape=shape
        )
        self.action_spec = Bounded(torch.full(one, -1.0), torch.full(one, 3.0))
        self.reward_spec = Unbounded(one)
        flags = {key: Binary(1, shape=one, dtype=torch.bool) for key in ("done", "terminated")}
        self.full_done_spec = Composite(flags, shape=shape)
        self.x = torch.zeros(one)
        self.generator = torch.Generator()
        self.set_seed(seed)

    def _emit(self, **kwargs):
        done = self.x > 5.0
        place = torch.stack([self.x, -self.x, 2 * self.x, torch.ones_like(self.x)], -1).view(-1, 2, 2)
        return TensorDict(
            place=place, far=self.x > 2.0, done=done, terminated=done, **kwargs, batch_size=self.batch_size
        )

    def _reset(self, tensordict=None, **kwargs):
        mask = torch.ones_like(self.x, dtype=torch.bool) if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones_like(self.x, dtype=torch.bool) if mask is None else mask
        drawn = torch.rand(self.x.shape, generator=self.generator)
        self.x = torch.where(mask, drawn, self.x)
        return self._emit()

    def _step(self, tensordict):
        self.x = self.x + tensordict["action"]
        return self._emit(reward=self.x.clone())

    def _set_seed(self, seed):
        if seed is not None:
            self.generator.manual_seed(seed)


class Lasting(Points):
    """The same, whose state can be saved."""

    def get_extra_state(self):
        return {"x": self.x.clone(), "generator": self.generator.get_state()}

    def set_extra_state(self, state):
        self.x = state["x"].clone()
        self.generator.set_state(state["generator"])


class Widening(Points):
    """Points whose flags have two entries, unlike their specs say."""

    def _step(self, tensordict):
        return super()._step(tensordict).set("far", torch.zeros(*self.batch_size, 2, dtype=torch.bool))


def play(env, actions):
    """Play actions ``(T, N, 1)``, with resets; return the outcomes, ``(N, T)``."""
    state = env.reset()
    outcomes = []
    for action in actions:
        step, state = env.step_and_maybe_reset(state.set("action", action))
        outcomes.append(step.clone())
    return torch.stack(outcomes, 1)
