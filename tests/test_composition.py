"""Every method, task, character and stage: what composes, and what no environment has."""

from itertools import product
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from refusals import refused

from torchrl_mcp import conf
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.runs.imports import require_environment

CONF = Path(conf.__file__).parent
METHODS, CHARACTERS, STAGES = (
    [path.stem for path in sorted((CONF / group).glob("*.yaml"))] for group in ("method", "character", "stage")
)
WALKERS = {"biped", "humanoid", "trex"}
TASKS = {  # characters that can do it, the one it takes by default, and its stages
    "carry": (WALKERS, "biped", {"transfer"}),
    "dribble": (WALKERS, "biped", {"transfer"}),
    "heading": (WALKERS, "biped", {"transfer"}),
    "holdout": ({"ant"}, "ant", {"pretrain", "transfer"}),
    "imitation": (WALKERS, "biped", {"pretrain"}),
    "location": (WALKERS, "biped", {"transfer"}),
}
OTHERS = {"gymnasium", "torchrl"}
"""Tasks of other libraries, which have bodies of their own."""


def composed(*overrides):
    return compose_run(*overrides, "run_dir=never")


def test_there_are_no_others():
    assert len(METHODS) == 7
    assert set(CHARACTERS) == WALKERS | {"ant", "none"}
    assert {path.stem for path in (CONF / "task").glob("*.yaml")} == set(TASKS) | OTHERS


@pytest.mark.parametrize(("task", "stage", "method"), product(sorted(OTHERS), STAGES, METHODS))
def test_tasks_of_other_libraries_have_every_method_in_both_stages_and_no_character(task, stage, method):
    own = "task.pretrain.env._target_=torchrl.envs.GymEnv" if task == "torchrl" else "task.pretrain.id=Pendulum-v1"
    cfg = composed(f"task={task}", f"stage={stage}", f"method={method}", own)
    assert cfg.character.name == "none"
    require_environment(cfg)


@pytest.mark.parametrize(
    ("task", "method"),
    [(task, "mcp") for task in TASKS] + [(task, m) for m in METHODS if m != "mcp" for task in ("imitation", "heading")],
)
def test_a_task_takes_its_own_character_and_refuses_those_that_cannot_do_it_with_a_remedy(task, method):
    able, default, stages = TASKS[task]
    cfg = composed(f"task={task}", f"method={method}")
    assert cfg.character.name == default
    for character, stage in product(CHARACTERS, STAGES):
        cfg.character, cfg.stage = (
            OmegaConf.load(CONF / group / f"{choice}.yaml")
            for group, choice in (("character", character), ("stage", stage))
        )
        if character in able and stage in stages:
            require_environment(cfg)
            assert OmegaConf.to_container(cfg, resolve=True)["parts"]["_target_"].startswith("torchrl_mcp.")
            continue
        remedy = "stage=transfer" if stage not in stages else f"character={' or '.join(sorted(able))}"
        refused(lambda: require_environment(cfg), f"task={task}", remedy)


@pytest.mark.parametrize(
    ("method", "mixer", "activation"), [("mcp", "multiplicative", "Sigmoid"), ("moe", "additive", "Softmax")]
)
def test_a_mixture_of_experts_differs_from_mcp_in_mixer_and_gate(method, mixer, activation):
    cfg = composed(f"method={method}")
    assert (cfg.mixer.name, cfg.gating.activation._target_) == (mixer, f"torch.nn.{activation}")


@pytest.mark.parametrize("character", sorted(WALKERS))
def test_a_character_that_is_asked_for_wins(character):
    assert composed("task=heading", "method=moe", f"character={character}").character.name == character


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_an_optimiser_without_a_schedule_has_none_with_any_preset(preset):
    cfg = composed("task=heading", f"preset={preset}", "optimizer=sgd")
    assert cfg.optimizer.schedule is None
    assert cfg.optimizer.actor._target_ == "torch.optim.SGD"


@pytest.mark.parametrize("optimizer", sorted(path.stem for path in (CONF / "optimizer").glob("*.yaml")))
def test_every_optimiser_takes_the_step_sizes_of_actor_and_critic(optimizer):
    sizes = ["step_size.actor=2e-4", "step_size.critic=3e-3"]
    cfg = composed("task=heading", f"optimizer={optimizer}", *sizes)
    assert (cfg.optimizer.actor.lr, cfg.optimizer.critic.lr) == (2e-4, 3e-3)


@pytest.mark.parametrize("method", METHODS)
def test_the_step_size_of_the_critic_in_the_paper_s_preset_is_the_one_that_its_optimiser_uses(method):
    cfg = composed("task=heading", "stage=transfer", f"method={method}", "preset=paper")
    assert cfg.step_size.critic == cfg.optimizer.critic.lr == 0.01  # "V Stepsize" or "Q Stepsize" of Tables 5-11


def test_a_task_that_has_no_settings_of_its_own_takes_the_defaults():
    cfg = composed("task=heading", "method=scratch")
    assert dict(cfg.training) == {
        "num_envs": 128,
        "frames_per_batch": 4096,
        "minibatch_size": 512,
        "num_epochs": 4,
        "warmup_batches": 1,
        "total_frames": 5_000_000,
    }
    assert cfg.optimizer.schedule.target_kl == 0.02
    imitation = composed("task=imitation")
    assert (imitation.training.total_frames, imitation.optimizer.schedule.target_kl) == (10_000_000, 0.05)
    assert (composed().training.num_envs, composed().training.minibatch_size) == (64, 512)


def tuned(task, method):
    return CONF / "tuned" / task / f"{method}.yaml"


TUNED = sorted(path.relative_to(CONF / "tuned").with_suffix("").parts for path in (CONF / "tuned").glob("*/*.yaml"))


DIFFERENT = {(method, tuned(task, method).read_text()): (task, method) for task, method in TUNED}
"""Of tasks with the same tuned settings of a method, one."""


def place(task, method):
    stage = "pretrain" if task == "imitation" else "transfer"
    return f"task={task}", f"method={method}", f"stage={stage}"


@pytest.mark.parametrize(("task", "method"), TUNED)
def test_tuned_settings_are_of_a_task_and_a_method(task, method):
    assert task in TASKS
    assert method in METHODS
    settings = OmegaConf.load(tuned(task, method))
    assert settings
    cfg = composed(*place(task, method))
    assert cfg == OmegaConf.merge(cfg, settings)


@pytest.mark.parametrize(("task", "method"), DIFFERENT.values())
def test_no_tuned_setting_enters_the_paper_s(task, method):
    # Those of Adam alone, which the paper did not use, may differ.
    papers = [composed(*place(task, method), "preset=paper", *without) for without in ([], ["~tuned"])]
    for paper in papers:
        del paper.step_size.max, paper.step_size.target_kl
    assert papers[0] == papers[1]


@pytest.mark.parametrize("method", METHODS)
def test_products_and_latent_spaces_explore_over_weights_unless_the_paper_s_settings_are_asked_for(method):
    explored = {
        (stage, preset): composed("task=holdout", f"method={method}", f"stage={stage}", f"preset={preset}")
        for stage in STAGES
        for preset in ("fast", "paper")
    }
    over_weights = {
        key for key, cfg in explored.items() if cfg.actor._target_.endswith(("weights_actor", "latents_actor"))
    }
    explores = method in ("mcp", "latent_space")
    assert over_weights == ({("transfer", "fast")} if explores else set())
    bound = explored["transfer", "fast"].objective.loss.get("bound_coeff", 10.0)
    without_bounds = explores or method == "hierarchical"  # logits, latent variables and choices have none
    assert bound == (0.0 if without_bounds else 10.0)


SHARED = ["observation_normaliser"]
TRANSFER = {  # what a method keeps of its pre-training, and what of that does not learn any more (appendix E)
    "scratch": ([], []),
    "finetune": (["policy", *SHARED], []),
    "hierarchical": (["primitives", *SHARED],) * 2,
    "option_critic": (["options", "terminations", *SHARED],) * 2,
    "moe": (["primitives", *SHARED],) * 2,
    "latent_space": (["decoder", *SHARED],) * 2,
    "mcp": (["primitives", *SHARED],) * 2,
}


@pytest.mark.parametrize("method", METHODS)
def test_transfer_keeps_and_freezes_what_the_paper_says(method):
    cfg = composed(f"method={method}", "task=heading", "stage=transfer")
    assert (list(cfg.transfer.keep), list(cfg.transfer.freeze)) == TRANSFER[method]


ANYWHERE = [-3.141592653589793, 3.141592653589793]
PLAIN = {"curriculum": None}
PLAIN |= {"terminate_on_fall": True, "self_collision": False, "friction_cone": "pyramidal", "physics_timestep": None}
OBJECT = PLAIN | {"target_distances": [0.0, 10.0], "object_directions": ANYWHERE, "target_directions": ANYWHERE}
OBJECT |= {
    "success_reward": False,
    "target_distance_power": 2,
    "speed": 1.0,
    "max_episode_steps": 900,
}
EVALUATED = {  # appendix D, and what docs/decisions.md adds
    "heading": PLAIN | {"initial_directions": [0.0, 0.0], "max_turn": 0.15, "speed": 1.0, "max_episode_steps": 600},
    "carry": OBJECT | {"object_distances": [0.0, 10.0]},
    "dribble": OBJECT | {"object_distances": [0.5, 10.0]},
}


@pytest.mark.parametrize("task", EVALUATED)
def test_policies_are_evaluated_in_the_task_of_the_paper(task):
    cfg = composed(f"task={task}", "stage=transfer")
    found = OmegaConf.to_container(cfg.evaluation.environment, resolve=True)
    assert {name: found[name] for name in EVALUATED[task]} == EVALUATED[task]
    assert found.keys() - EVALUATED[task].keys() <= {
        "goal_positions",
        "waypoint",
        "speed_interval",
    }  # its own; without effect
