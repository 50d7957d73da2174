"""Values of settings: which are refused before anything is written, and how."""

from functools import cache
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from refusals import refused

from torchrl_mcp import conf
from torchrl_mcp.envs import Heading
from torchrl_mcp.runs import experiment
from torchrl_mcp.runs.arguments import argument_types
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.runs.validation import require_valid, require_values, resolved, types_of_settings, with_rules
from torchrl_mcp.values import Count

METHODS = sorted(path.stem for path in (Path(conf.__file__).parent / "method").glob("*.yaml"))
PLACES = [(method, "heading") for method in METHODS] + [
    ("mcp", task) for task in ("holdout", "imitation", "location", "carry", "dribble")
]


@cache
def composed(*overrides):
    return compose_run("run_dir=never", *overrides)


def place(method, task):
    return f"method={method}", f"task={task}", f"stage={'pretrain' if task == 'imitation' else 'transfer'}"


@pytest.mark.parametrize(("method", "task"), PLACES)
def test_what_the_library_configures_is_valid(method, task):
    require_valid(composed(*place(method, task)))


PRESETS = ("paper", "smoke", "demo", "demo_smoke", "comparison")


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_valid(preset):
    for method, task in (("mcp", "holdout"), ("hierarchical", "heading")):
        require_valid(composed(*place(method, task), f"preset={preset}"))


def test_settings_of_a_method_hold_in_the_stage_that_they_name():
    pretrain, transfer = (composed(*place("moe", task)) for task in ("imitation", "heading"))
    assert (pretrain.optimizer.actor.lr, pretrain.optimizer.schedule.target_kl) == (6e-5, 0.2)
    assert composed(*place("mcp", "imitation")).optimizer.schedule.target_kl == 0.05
    assert pretrain.action_std == 0.05
    assert transfer.optimizer.actor.lr == composed(*place("mcp", "heading")).optimizer.actor.lr
    assert transfer.action_std == transfer.character.action_std
    assert composed(*place("finetune", "heading")).action_std == 0.1
    assert composed(*place("finetune", "dribble")).action_std == 0.05
    gate = composed(*place("hierarchical", "dribble"))
    assert (gate.training.minibatch_size, gate.optimizer.schedule.max_lr) == (64, 2e-3)
    assert composed(*place("scratch", "dribble")).training.minibatch_size == 2048


@pytest.mark.parametrize("word", ["step_size.actor=0.1", "step_size.actor=1e-6", "step_size.max=2e-5"])
def test_a_step_size_that_the_first_update_would_replace_is_refused(word):
    cfg = composed(*place("mcp", "heading"), word)
    refused(lambda: require_valid(cfg), "step_size.actor", "step_size.max")


@pytest.mark.parametrize("size", ["training.num_envs=48", "training.minibatch_size=100"])
def test_a_batch_that_does_not_divide_is_refused_with_the_numbers_of_the_settings(size):
    plain = composed(*place("mcp", "dribble"), "training.frames_per_batch=4096", size)
    message = refused(lambda: require_valid(plain), "training.frames_per_batch=4096", size)
    assert "batch_factor" not in message
    choices = composed(*place("hierarchical", "heading"), "training.frames_per_batch=4096", size)
    refused(lambda: require_valid(choices), "training.frames_per_batch=4096", "batch_factor=8", size)


def test_a_batch_may_divide_only_with_its_factor():
    require_valid(composed(*place("hierarchical", "heading"), "training.num_envs=8", "training.minibatch_size=32768"))


def test_a_batch_that_may_contain_no_choice_is_refused():
    words = ["training.num_envs=512", "training.frames_per_batch=4096"]
    require_valid(composed(*place("hierarchical", "heading"), *words, "steps_per_choice=64"))
    longer = composed(*place("hierarchical", "heading"), *words, "steps_per_choice=65")
    refused(lambda: require_valid(longer), "steps_per_choice=65", "training.num_envs", "training.frames_per_batch")


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["method=mcp", "task=imitation", "primitives=separate"], ["primitives.initial_std"]),
        (["method=scratch", "task=gymnasium", "preset=paper"], ["step_size.actor=..."]),
    ],
)
def test_a_reference_to_a_setting_that_the_chosen_groups_lack_is_named(words, names):
    refused(lambda: require_valid(composed(*words)), *names)


def test_a_run_from_python_is_asked_for_its_folder():
    refused(lambda: require_valid(compose_run("method=scratch", "task=holdout")), "run_dir=FOLDER")


WRONG = {
    "seed": ["null", "-1", "1.5", "many", str(2**32)],
    "training.num_envs": ["0", "1.5", "null", "-4", "[1]"],
    "training.frames_per_batch": ["0", "nan", "1e3"],
    "training.minibatch_size": ["0", "null"],
    "training.num_epochs": ["0", "-1", "true"],
    "training.total_frames": ["-5", "nan", "inf", "0", "soon"],
    "checkpoint_interval": ["0", "null"],
    "keep_checkpoints": ["0"],
    "num_threads": ["-1", "all"],
    "torch_threads": ["0", "many"],
    "progress_bar": ["1", "maybe"],
    "autocast": ["perhaps", "2"],
    "evaluation.episodes": ["-1", "1.5", "null"],
    "evaluation.seed": ["-1", "null"],
    "stage.gamma": ["1", "2", "-0.1", "nan", "null"],
    "objective.advantages.lmbda": ["1.5", "-1"],
    "objective.advantages.clip": ["0", "-4"],
    "objective.max_grad_norm": ["-1", "0", ".nan", ".inf"],
    "objective.loss.clip_epsilon": ["-1", "0", "1", "1.5", "wide"],
    "objective.loss.bound_coeff": ["-1"],
    "optimizer.actor.lr": ["0", "-1e-3", "nan", "fast"],
    "optimizer.actor.fused": ["2"],
    "optimizer.schedule.target_kl": ["0", "-1"],
    "critic.num_cells": ["[]", "[x]", "[0]", "5", "[1.5]"],
    "num_primitives": ["0", "eight", "1.5", "null"],
    "primitives.network.trunk_cells": ["[1024,0]", "null"],
    "character.action_std": ["0", "-1"],
    "transfer.freeze": ["primitives", "[1]"],
    "device": ["null", "5"],
    "task.evaluation.max_episode_steps": ["0", "1.5"],
    "task.evaluation.directions": ["[2,1]", "[1]", "east"],
    "task.evaluation.forward_weight": ["-1", "nan"],
    "task.evaluation.terminate_when_unhealthy": ["2"],
    "training": ["null", "5"],
    "objective": ["null"],
    "method": ["{}"],
}


@pytest.mark.parametrize(("setting", "value"), [(name, value) for name, values in WRONG.items() for value in values])
def test_a_value_that_a_setting_cannot_have_is_named(setting, value):
    cfg = composed().copy()
    OmegaConf.set_struct(cfg, False)
    OmegaConf.update(cfg, setting, OmegaConf.create(f"value: {value}").value, merge=False)
    refused(lambda: require_valid(cfg), setting)


def test_all_wrong_values_are_named_at_once_and_no_folder_is_made(tmp_path):
    cfg = composed().copy()
    cfg.run_dir, cfg.seed, cfg.training.num_epochs = str(tmp_path / "run"), None, 0
    refused(lambda: experiment.train(cfg), "seed=null", "training.num_epochs=0")
    assert list(tmp_path.iterdir()) == []


def test_an_evaluation_of_a_task_without_the_stage_has_the_rules_of_the_other_stage():
    cfg = composed("task=heading", "stage=pretrain", "task.evaluation.speed=0")
    refused(lambda: require_valid(cfg), "task.evaluation.speed=0")


def test_a_missing_value_is_asked_for():
    cfg = composed("task=imitation", "motions=folder")
    refused(lambda: require_valid(cfg), "motions.path")


@pytest.mark.parametrize(
    ("folder", "names"),
    [
        ("runs/imitation-biped/pretrain/mcp/motions.path-../../../../../../elsewhere/seed0", ["run_root=runs"]),
        ("~/elsewhere", ["run_dir=~/elsewhere", f"run_dir={Path.home()}/elsewhere"]),
        ("../elsewhere", []),
    ],
)
def test_no_setting_takes_a_run_out_of_the_folder_of_runs(folder, names):
    cfg = composed().copy()
    cfg.run_dir = folder
    if names:
        refused(lambda: require_valid(cfg), *names)
    else:
        require_valid(cfg)


FOLDER = Path(conf.__file__).parent
CHOICES = [
    f"{path.parent.name}={path.stem}"
    for group in ("collector", "curriculum", "exploration", "imitation", "motions", "optimizer", "physics", "symmetry")
    for path in sorted((FOLDER / group).glob("*.yaml"))
    if path.stem != "base"
]
CONFIGURATIONS = [
    *(place(method, task) for method in METHODS for task in ("heading", "imitation")),
    *(place("mcp", task) for task in ("holdout", "location", "carry", "dribble", "gymnasium", "torchrl")),
    *((*place("mcp", "heading"), choice) for choice in CHOICES if not choice.startswith(("imitation", "motions"))),
    *((*place("mcp", "imitation"), choice) for choice in CHOICES if choice.startswith(("imitation", "motions"))),
    *((*place("hierarchical", "heading"), f"preset={preset}") for preset in PRESETS),
]
TABLES = ("method.paper.", "method.standard.", "goal.", "hierarchy.", "budget.", "encoder.", "demo.")
OTHER = ("_partial_", "backend_options.")  # Hydra and Ray check these settings


@pytest.mark.parametrize("words", CONFIGURATIONS, ids=" ".join)
def test_every_number_flag_and_list_has_a_rule(words):
    config = resolved(composed(*words))
    settings = list(with_rules(config, types_of_settings(config)))
    free = [name for name, value, rule in settings if rule is None and isinstance(value, bool | int | float | list)]
    assert len(settings) > 100
    assert not [name for name in free if not (name.startswith(TABLES) or any(other in name for other in OTHER))]


class Bench(Heading):
    """A task of a user, which passes arguments on to its bases."""

    def __init__(self, character, num_envs, *, places: Count, fast: bool = None, speed=1.0, **kwargs):  # noqa: RUF013
        super().__init__(character, num_envs, speed=speed, **kwargs)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("places", 0),
        ("fast", 2),
        ("max_episode_steps", 0),
        ("speed", -1.0),
        ("physics_timestep", 0.0),
        ("curriculum.success_worth", 0),
    ],
)
@pytest.mark.parametrize("group", ["transfer", "evaluation"])
def test_the_arguments_of_a_user_s_task_have_the_rules_of_its_signature_and_of_its_bases(setting, value, group):
    cfg = composed(*place("mcp", "heading")).copy()
    OmegaConf.set_struct(cfg, False)
    cfg.task.transfer = {"_target_": f"{__name__}.Bench", "_partial_": True, "places": 3, "fast": None}
    require_valid(cfg)
    OmegaConf.update(cfg, f"task.{group}.{setting}", value, force_add=True)
    refused(lambda: require_valid(cfg), f"task.{group}.{setting}={value}")


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"max_error": 0.0}, "max_error=0.0"),
        ({"terms": {"pose": {"weight": -1.0}}}, "terms.pose.weight=-1.0"),
        ({"clips": {"seed": -1}}, "clips.seed=-1"),
    ],
)
def test_a_wrong_value_of_an_argument_that_replaces_one_of_the_task_is_named(given, line):
    task = resolved(composed(*place("mcp", "imitation")))["task"]["pretrain"]
    require_values(task, {"max_error": 0.5, "terms": {"pose": {"weight": 2}}, "clips": {"seed": 1}})
    refused(lambda: require_values(task, given), line)


def test_a_group_in_place_of_a_value_is_named():
    cfg = composed().copy()
    OmegaConf.set_struct(cfg, False)
    cfg.checkpoint_interval = {"iterations": 25}
    refused(lambda: require_valid(cfg), "checkpoint_interval")


@pytest.mark.parametrize("target", ["torch.sigmoid", "builtins.dict", "nowhere.Class", "5", "collections.Counter"])
def test_a_target_without_a_signature_in_python_has_no_rules(target):
    assert argument_types(target) == {}
