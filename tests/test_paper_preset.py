"""Tables 5-11 of the paper as data, against the trainer that ``preset=paper`` builds."""

from pathlib import Path

import pytest
import torch

from torchrl_mcp import conf
from torchrl_mcp.runs import build
from torchrl_mcp.runs.configuration import compose_run

CHARACTERS = ("biped", "humanoid", "trex")

# Parameter: biped, humanoid, T-Rex.
PPO_ROWS = {
    "V Stepsize": (1e-2, 1e-2, 1e-2),
    "Batch Size": (4096, 4096, 4096),
    "Minibatch Size": (256, 256, 256),
    "SGD Momentum": (0.9, 0.9, 0.9),
    "TD(lambda)": (0.95, 0.95, 0.95),
    "GAE(lambda)": (0.95, 0.95, 0.95),
    "PPO Clip Threshold": (0.02, 0.02, 0.02),
}
TABLES = {
    "mcp": {  # Table 5
        "k Primitives": (8, 8, 8),
        "pi Stepsize (Pre-Train)": (2e-5, 1e-5, 1e-5),
        "pi Stepsize (Transfer)": (5e-5, 5e-5, 5e-5),
        **PPO_ROWS,
    },
    "scratch": {"pi Stepsize": (2.5e-6, 2.5e-6, 1e-6), **PPO_ROWS},  # Table 6
    "finetune": {"pi Stepsize": (2.5e-6, 2.5e-6, 1e-6), **PPO_ROWS},  # Table 7
    "hierarchical": {  # Table 8, of which "pi" is the gate; it has no T-Rex
        "k Primitives": (7, 7),
        "pi Stepsize (Transfer)": (1e-3, 1e-3),
        **{name: values[:2] for name, values in PPO_ROWS.items()},
    },
    "option_critic": {  # Table 9
        "k Options": (8, 8, 8),
        "pi Stepsize": (2.5e-6, 2.5e-6, 1e-6),
        "beta Stepsize": (2.5e-6, 2.5e-6, 1e-6),
        "Q Stepsize": (1e-2, 1e-2, 1e-2),
        "Batch Size": (256, 256, 256),
        "SGD Momentum": (0.9, 0.9, 0.9),
        "Termination Cost": (0.01, 0.01, 0.01),
    },
    "moe": {"k Primitives": (8, 8, 8), "pi Stepsize": (1e-5, 5e-6, 2e-6), **PPO_ROWS},  # Table 10
    "latent_space": {  # Table 11
        "w Latent Size": (8, 8, 8),
        "pi Stepsize (Pre-Train)": (5e-6, 2.5e-6, 1e-6),
        "pi Stepsize (Transfer)": (5e-5, 5e-5, 5e-5),
        "beta KL Regularizer": (1e-4, 1e-4, 1e-4),
        **PPO_ROWS,
    },
}
# Appendix E, before the tables.
DISCOUNT = {"pretrain": 0.95, "transfer": 0.99}

# The same authors' public code of DeepMimic, whose imitation section 4 takes over: weights and scales.
REWARD = {
    "pose": (0.5, 2.0),
    "velocity": (0.05, 0.1),
    "key_positions": (0.15, 40.0),  # of the end effectors
    "root_pose": (0.2, 5.0),
    "com": (0.1, 10.0),
}

# Appendix E: hidden units.
LAYERS = {
    ("mcp", "pretrain"): {"gating": {512, 256}, "primitives": {512, 256}},
    ("mcp", "transfer"): {"gating": {512, 256}},
    ("scratch", "transfer"): {"policy": {1024, 512}},
    **{("finetune", stage): {"policy": {1024, 512}} for stage in ("pretrain", "transfer")},
    ("hierarchical", "pretrain"): {"primitives": {1024, 512}},
    ("hierarchical", "transfer"): {"gating": {1024, 512}},
    **{("option_critic", stage): {"critic": {1024, 512}} for stage in ("pretrain", "transfer")},
    ("moe", "pretrain"): {"gating": {1024, 512}, "primitives": {1024, 512}},
    ("moe", "transfer"): {"gating": {1024, 512}},
    ("latent_space", "pretrain"): {"encoder": {256, 128}, "decoder": {1024, 512}},
    ("latent_space", "transfer"): {"encoder": {1024, 512}},
}

STEP_SIZES = ("pi Stepsize", "pi Stepsize (Pre-Train)", "pi Stepsize (Transfer)", "beta Stepsize")
METHODS = sorted({path.stem for path in (Path(conf.__file__).parent / "method").glob("*.yaml")} & set(TABLES))


def configure(method, stage, *overrides):
    task = {"pretrain": "imitation", "transfer": "heading"}[stage]
    settings = ["preset=paper", f"method={method}", f"stage={stage}", f"task={task}", "num_threads=1", *overrides]
    return compose_run(*settings)


@pytest.fixture(scope="module", params=sorted(LAYERS), ids="-".join)
def built(request, tmp_path_factory):
    """A method, a stage, and the trainer of the biped that the preset builds for them."""
    method, stage = request.param
    folder = tmp_path_factory.mktemp("run")
    cfg = configure(method, stage, f"run_dir={folder}", "training.num_envs=4")  # of 64, which no table has
    source = build.make_source(cfg)
    return method, stage, build.make_trainer(cfg, build.make_agent(cfg, source.env), source, folder)


def step_size(trainer, name):
    """How far the trainer goes along a gradient of 1000 at the first step, for each unit of it; if it trains that."""
    if name not in trainer.update.objective.optimizers:
        return None
    (group,) = trainer.update.objective.optimizers[name].param_groups
    before = [parameter.detach().clone() for parameter in group["params"]]
    for parameter in group["params"]:
        parameter.grad = torch.full_like(parameter, 1000.0)
    trainer.update._step(trainer.update.objective.optimizers[name])
    gone = {round((old - new).median().item() / 1000, 9) for old, new in zip(before, group["params"], strict=True)}
    assert max(gone) - min(gone) < 1e-3 * max(gone)
    return max(gone)


def test_what_one_optimiser_trains_the_other_s_loss_does_not_read(built):
    """They learn at the same time."""
    *_, trainer = built
    for name, other in (("actor", "critic"), ("critic", "actor")):
        groups = (
            trainer.update.objective.optimizers[name].param_groups
            if name in trainer.update.objective.optimizers
            else ()
        )
        trained = {parameter for group in groups for parameter in group["params"]}
        assert trained.isdisjoint(trainer.update.objective.losses[other].parameters())


def decays(trainer):
    gae = getattr(trainer.update.objective.advantages, "gae", None)
    estimator = gae.estimator if gae else trainer.update.objective.advantages
    return float(estimator.lmbda), float(estimator.gamma)


def skills(trainer):
    """How many primitives, options or latent numbers there are, by the sizes of the networks."""
    parts = trainer.agent.parts
    if "decoder" in parts:
        return parts["decoder"].body[0].in_features - parts["observation_normaliser"].mean.numel()
    if "primitives" in parts:
        return len(getattr(parts["primitives"], "policies", [])) or parts["primitives"].output.bias.shape[0]
    return parts["options"].output.bias.shape[0]


def test_the_preset_builds_a_trainer_with_the_table_of_each_method(built):
    method, stage, trainer = built
    other = {"pretrain": "(Transfer)", "transfer": "(Pre-Train)"}[stage]
    table = {row: values[0] for row, values in TABLES[method].items() if not row.endswith(other)}
    if method == "hierarchical" and stage == "pretrain":
        table["pi Stepsize"] = TABLES["scratch"]["pi Stepsize"][0]  # Table 8 is of the gate
    lmbda, gamma = decays(trainer)
    assert lmbda == pytest.approx(0.5 if method == "option_critic" else 0.95)  # Table 9 has none
    assert gamma == pytest.approx(DISCOUNT[stage])
    steps_per_sample = 30 if (method, stage) == ("hierarchical", "transfer") else 1  # Table 8: a sample is a choice
    assert (trainer.settings.frames_per_batch / steps_per_sample, trainer.settings.minibatch_size) == (
        table["Batch Size"],
        256,
    )
    assert (
        trainer.settings.num_epochs,
        trainer.update.objective.schedule,
        trainer.settings.autocast,
        trainer.settings.warmup_batches,
    ) == (1, None, False, 0)
    for optimizer in trainer.update.objective.optimizers.values():
        (group,) = optimizer.param_groups
        assert isinstance(optimizer, torch.optim.SGD)
        assert (group["momentum"], group["weight_decay"], group["nesterov"]) == (table["SGD Momentum"], 0, False)
    assert step_size(trainer, "critic") == pytest.approx(table.get("V Stepsize", table.get("Q Stepsize")), rel=1e-3)
    steps = {value for row, value in table.items() if row in STEP_SIZES}
    if method == "option_critic" and stage == "transfer":
        assert step_size(trainer, "actor") is None  # options and terminations are kept
    else:
        assert [step_size(trainer, "actor")] == [pytest.approx(step, rel=0.01) for step in steps]
    if "PPO Clip Threshold" in table:
        assert float(trainer.update.objective.losses["actor"].clip_epsilon) == pytest.approx(
            table["PPO Clip Threshold"]
        )
    if "Termination Cost" in table:
        assert trainer.update.objective.advantages.termination_cost == table["Termination Cost"]
    if "beta KL Regularizer" in table:
        assert trainer.update.objective.losses["actor"].kl_coeff == table["beta KL Regularizer"]
    for row in ("k Primitives", "k Options", "w Latent Size"):
        if row in table:
            assert skills(trainer) == table[row]


def test_the_preset_builds_the_layers_of_appendix_e(built):
    method, stage, trainer = built
    for part, widths in {**LAYERS[method, stage], "critic": {1024, 512}}.items():
        linear = [layer for layer in trainer.agent.parts[part].modules() if isinstance(layer, torch.nn.Linear)]
        hidden = {layer.out_features for layer in linear if layer.out_features > 34}
        assert hidden == widths, part


def test_the_preset_imitates_by_the_reward_of_deepmimic(built):
    method, stage, trainer = built
    if stage == "transfer":
        return
    env = trainer.source.env
    assert {name: (term.weight, term.scale) for name, term in env.terms.items()} == REWARD
    switches_randomly = method not in ("finetune", "hierarchical")  # which imitate a single motion, or one each
    assert (env.switch_candidates == 1, env.switch_to) == (switches_randomly, "any" if switches_randomly else "same")


@pytest.mark.parametrize("stage", ["pretrain", "transfer"])
@pytest.mark.parametrize("method", METHODS)
def test_the_preset_has_the_step_sizes_of_each_character(method, stage):
    cfg = configure(method, stage)
    other = {"pretrain": "(Transfer)", "transfer": "(Pre-Train)"}[stage]
    for row, values in TABLES[method].items():
        if row not in STEP_SIZES or row.endswith(other):
            continue
        for character, value in zip(CHARACTERS, values, strict=False):
            cfg.character.name = character
            assert cfg.optimizer.actor.lr == value, (row, character)
        if method != "hierarchical":
            # No table has the ant: it takes the biped's values. The paper has no hierarchical model of it.
            cfg.character.name = "ant"
            assert cfg.optimizer.actor.lr == values[0], (row, "ant")
