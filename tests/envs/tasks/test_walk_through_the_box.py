"""A walker that is led straight through the box: what happens is the task's doing, not the policy's."""

import pytest
import torch
from chance import require_share
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.envs import Carry, Imitation
from torchrl_mcp.envs.motions.single import single_motion
from torchrl_mcp.envs.rotations import about_z
from torchrl_mcp.runs import build, policies
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.training import checkpoint

TRIALS, STEPS = 16, 150
AHEAD = {"biped": 1.2, "humanoid": 1.2, "trex": 2.2}  # metres to the box


class Guide:
    """The built-in network of a character, which follows a walk along x that waits for it, from sixteen moments on."""

    def __init__(self, character):
        walk, terms = single_motion(character), {"pose": {"weight": 1.0, "scale": 1.0}}
        self.env = Imitation(character, walk, TRIALS, terms=terms, seed=0, num_threads=1)
        file = builtin("mcp", character)
        agent = build.make_agent(policies.policy_config(file), self.env)
        checkpoint.load_agent(agent.parts, file)
        self.policy, self.walk = agent.actor.policy, walk
        self.times = 0.075 * torch.arange(TRIALS, dtype=torch.float64)
        self.begun = self.env.beginning(torch.zeros(TRIALS, dtype=torch.int64), self.times)
        way = self.places(self.times + 1) - self.places(self.times)
        self.forward = way / way.norm(dim=-1, keepdim=True)

    def places(self, times):
        return self.walk.at(self.begun["clip"], times).qpos[:, :2]

    def action(self, state, step):
        own = {key: state[key][:, : self.begun[key].shape[1]] for key in ("qpos", "qvel")}
        times = self.times + step / 30
        behind = own["qpos"][:, :2] - self.places(times) - self.begun["shift"]
        shift = self.begun["shift"] + self.forward * (behind * self.forward).sum(-1, keepdim=True)
        seen = self.env.reset(
            TensorDict({**self.begun, **own, "time": times, "shift": shift}, [TRIALS]), set_state=True
        )
        return self.policy(seen.select(*self.policy.in_keys))["action"]


@pytest.mark.trajectories
@pytest.mark.parametrize("character", AHEAD)
def test_most_who_walk_through_the_box_carry_it_past_the_source(character):
    guide, env = Guide(character), Carry(character, TRIALS, seed=0, num_threads=1)
    env.reset()
    state = env.get_state()
    for key in ("qpos", "qvel"):
        state[key][:, : guide.begun[key].shape[1]] = guide.begun[key]
    source = AHEAD[character] * guide.forward
    state["qpos"][:, -7:-5] = state["mocap_pos"][:, 1, :2] = source
    state["mocap_pos"][:, 0, :2] = 20 * guide.forward
    turn = about_z(torch.atan2(*guide.forward.flip(-1).unbind(-1)))
    state["qpos"][:, -4:], state["mocap_quat"][:] = turn, turn.unsqueeze(1)
    carrier, past = env.reset(state, set_state=True), torch.zeros(TRIALS, dtype=torch.bool)
    fallen = past.clone()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        for step in range(STEPS):
            carrier = env.step(carrier.set("action", guide.action(env.get_state(), step)))["next"]
            fallen |= carrier["terminated"].squeeze(-1)
            state = env.get_state()
            beyond = ((state["qpos"][:, -7:-5] - source) * guide.forward).sum(-1)
            past |= (beyond > 1) & (state["eq_active"][:, 0] == 1) & ~fallen
    require_share(past & (env.episode["taken"] == 1), 0.95)  # 99 to 100 % of 128
