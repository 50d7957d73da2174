"""What the README shows works."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.parametrize("snippet", SNIPPETS, ids=lambda snippet: snippet.splitlines()[-1][:40])
def test_every_python_snippet_runs_by_itself(snippet):
    exec(compile(snippet, "README.md", "exec"), {})


def test_the_readme_begins_with_the_two_commands():
    setting_up = next(block for block in re.findall(r"```bash\n(.*?)```", README, re.DOTALL))
    assert "\nmake demo " in setting_up
    assert "\nmake test " in setting_up


def test_the_loss_of_the_stock_agent_reaches_every_parameter_of_its_actor():
    import torch
    from torchrl.envs import GymEnv
    from torchrl.objectives.value import GAE

    page = (ROOT / "docs" / "tutorials" / "agent.md").read_text()
    names = {}
    for snippet in re.findall(r"```python\n(.*?)```", page, re.DOTALL)[:2]:
        exec(compile(snippet.partition("\ncollector = ")[0], "agent.md", "exec"), names)
    torch.manual_seed(0)
    with torch.no_grad():
        batch = GymEnv("Pendulum-v1").rollout(20, names["actor"])
        batch = GAE(gamma=0.99, lmbda=0.95, value_network=names["critic"])(batch)
    losses = names["loss"](batch)
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    for name, parameter in names["actor"].named_parameters():
        assert parameter.grad.abs().sum() > 0, name
