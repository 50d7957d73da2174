"""A run that is watched: each new checkpoint is taken up, a damaged one is not."""

import copy

import pytest
import torch
from smoke import configure

from torchrl_mcp.runs import experiment, policies
from torchrl_mcp.training import checkpoint, run_folder
from torchrl_mcp.viewer.watch import Watch


@pytest.fixture
def run(tmp_path):
    """A run folder with the checkpoints of two moments, the later of which the test brings in."""
    folder = tmp_path / "run"
    experiment.train(configure(folder, "method=scratch", "task=heading", "stage=transfer"))
    later, earlier = run_folder.find_all(folder)
    aside = tmp_path / later.name
    later.rename(aside)
    return folder, earlier, aside


def numbers(parts):
    return torch.cat([parameter.flatten() for parameter in parts["policy"].parameters()]).clone()


def of(path):
    return numbers(policies.restore(path, num_envs=1, seed=0)[1].parts)


def test_each_new_checkpoint_is_taken_up_and_a_damaged_one_is_passed_over(run, capsys):
    folder, earlier, later = run
    _, agent, _ = policies.restore(folder, num_envs=1, seed=0)
    watch = Watch(folder, agent.parts, interval=0.0)
    assert watch()
    assert watch.frames == run_folder.frames(earlier) == 256
    first = numbers(agent.parts)
    assert not watch()

    newest = earlier.with_name(later.name)
    whole = later.read_bytes()
    newest.write_bytes(whole[: len(whole) // 2])  # half-written
    assert not watch()
    damaged = bytearray(whole)
    damaged[len(whole) // 3] ^= 0xFF
    newest.write_bytes(damaged)
    assert not watch()
    assert torch.equal(numbers(agent.parts), first)

    newest.write_bytes(whole)
    assert watch()
    assert watch.frames == 512
    assert torch.equal(numbers(agent.parts), of(later))
    assert not torch.equal(numbers(agent.parts), first)
    assert capsys.readouterr().out.splitlines()[-1] == "checkpoint-000000000512.torchrl: 512 steps"


def test_a_checkpoint_of_other_networks_changes_nothing(run, tmp_path):
    folder, earlier, later = run
    _, agent, _ = policies.restore(folder, num_envs=1, seed=0)
    watch = Watch(folder, agent.parts, interval=0.0)
    watch()
    before = copy.deepcopy(agent.parts.state_dict())
    other = policies.restore(later, num_envs=1, seed=0)[1].parts
    other["critic"] = torch.nn.Linear(1, 1)
    checkpoint.run_checkpoint(other).save(earlier.with_name(later.name), metadata={"config": {}})
    assert not watch()
    assert all(torch.equal(value, before[name]) for name, value in agent.parts.state_dict().items())


def test_the_folder_is_looked_at_every_so_often(run):
    folder, earlier, later = run
    _, agent, _ = policies.restore(folder, num_envs=1, seed=0)
    watch = Watch(folder, agent.parts, interval=60.0)
    assert watch()
    later.rename(earlier.with_name(later.name))
    assert not watch()
