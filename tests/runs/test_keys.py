"""Settings that nothing uses, and arguments that a class does not take."""

import pytest
from omegaconf import OmegaConf
from refusals import refused

from torchrl_mcp.runs.arguments import require_callable
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.runs.imports import require_environment
from torchrl_mcp.runs.requirements import require_used

METHODS = ("mcp", "moe", "scratch", "finetune", "hierarchical", "option_critic", "latent_space")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("task", ["imitation", "heading", "carry", "holdout"])
@pytest.mark.parametrize("others", [[], ["preset=paper", "stage=transfer", "symmetry=augment", "collector=processes"]])
def test_the_settings_of_the_library_are_all_used_and_its_arguments_taken(method, task, others):
    cfg = compose_run(f"method={method}", f"task={task}", "run_dir=run", *others)
    require_used(cfg)
    if not others:
        require_callable(OmegaConf.to_container(cfg, resolve=True))


@pytest.mark.parametrize(
    ("setting", "names"),
    [
        ("+training.total_framse=1", ["training.total_framse", "training.total_frames"]),
        ("+gatng.activation=1", ["gatng", "gating"]),
        ("+method.num_primitives=4", ["method.num_primitives"]),
        ("+task.task.name=own", ["task.task"]),
        ("+preset.seed=1", ["preset"]),
        ("+training.device=cpu", ["training.device", "device=..."]),
        ("~seed", ["seed"]),
    ],
)
def test_a_setting_that_is_misspelt_or_in_a_wrong_group_is_named(setting, names):
    refused(lambda: require_used(compose_run(setting)), *names)


@pytest.mark.parametrize(
    "settings",
    [
        ["+note.x0=1", "+repeat=0"],
        ["+maks=3", "+gating.k=${maks}"],
        ["+sede=3", "task.name=${oc.select:sede,1}"],
        ["+tasks.own=3", "+gating.k=${tasks.own}"],
        ["step_size=${training}"],
    ],
)
def test_labels_and_settings_of_ones_own_are_allowed(settings):
    require_used(compose_run(*settings))


@pytest.mark.parametrize(
    ("setting", "names"),
    [
        ("+task.transfer.max_trn=1", ["task.transfer.max_trn", "max_turn"]),
        ("+critic.widht=1", ["critic.widht", "width"]),
    ],
)
def test_an_argument_that_a_class_does_not_take_is_named_with_the_nearest(setting, names):
    cfg = compose_run("task=heading", "stage=transfer", "run_dir=run", setting)
    refused(lambda: require_callable(OmegaConf.to_container(cfg, resolve=True)), *names)


def test_code_of_others_is_left_to_python():
    require_callable({"activation": {"_target_": "torch.sigmoid", "_partial_": True, "gain": 1}})


def test_what_both_stages_share_is_not_given_for_one_of_them():
    cfg = compose_run("task=holdout", "stage=transfer", "+task.transfer.forward_weight=2.0")
    refused(lambda: require_environment(cfg), "task.transfer", "task.pretrain.NAME=VALUE")
