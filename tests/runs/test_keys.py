"""Settings that nothing uses, and arguments that a class does not take."""

import pytest
from omegaconf import OmegaConf

from torchrl_mcp.runs import requirements
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.runs.keys import require_used

METHODS = ("mcp", "moe", "scratch", "finetune", "hierarchical", "option_critic", "latent_space")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("task", ["imitation", "heading", "carry", "holdout"])
def test_the_settings_of_the_library_are_all_used_and_its_arguments_taken(method, task):
    cfg = compose_run(f"method={method}", f"task={task}", "run_dir=run")
    require_used(cfg)
    requirements.require_callable(OmegaConf.to_container(cfg, resolve=True))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("+foo=1", "nothing uses the setting foo: correct its name, or leave it out"),
        ("+training.total_framse=1", "training.total_framse: correct its name .training.total_frames"),
        ("+gatng.activation=1", "gatng: correct its name .gating"),
        ("+method.num_primitives=4", "method.num_primitives: begin the file of method= with the line '# @package"),
        ("+task.task.name=own", "task.task: begin the file of task= with"),
        ("+preset.seed=1", "preset: begin the file of preset= with"),
        ("~seed", "the setting seed is missing: leave ~seed out"),
    ],
)
def test_a_setting_that_nothing_uses_is_named_with_a_remedy(setting, message):
    with pytest.raises(ValueError, match=message):
        require_used(compose_run(setting))


def test_a_setting_of_ones_own_is_used_by_a_reference():
    require_used(compose_run("+top=3", "+half={of:3}", "+gating.k=${top}", "+gating.l=${half.of}"))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("+task.transfer.max_trn=1", "task.transfer.max_trn is no argument of torchrl_mcp.envs.Heading; .*: max_turn"),
        ("+critic.widht=1", "critic.widht is no argument of .*value_critic; the nearest are: width"),
    ],
)
def test_an_argument_that_a_class_does_not_take_is_named_with_the_nearest(setting, message):
    cfg = compose_run("task=heading", "stage=transfer", "run_dir=run", setting)
    with pytest.raises(ValueError, match=message):
        requirements.require_callable(OmegaConf.to_container(cfg, resolve=True))
