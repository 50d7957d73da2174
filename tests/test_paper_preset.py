"""Tables 5-11 of the paper as data, against what ``preset=paper`` composes."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_module

from torchrl_mcp import conf

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

SETTINGS = {
    "k Primitives": "num_primitives",
    "k Options": "num_options",
    "w Latent Size": "latent_dim",
    "pi Stepsize": "optimizer.actor.lr",
    "pi Stepsize (Pre-Train)": "optimizer.actor.lr",
    "pi Stepsize (Transfer)": "optimizer.actor.lr",
    "beta Stepsize": "optimizer.actor.lr",
    "V Stepsize": "optimizer.critic.lr",
    "Q Stepsize": "optimizer.critic.lr",
    "Batch Size": "training.frames_per_batch",
    "Minibatch Size": "training.minibatch_size",
    "SGD Momentum": "optimizer.actor.momentum",
    "TD(lambda)": "objective.advantages.lmbda",
    "GAE(lambda)": "objective.advantages.lmbda",
    "PPO Clip Threshold": "objective.loss.clip_epsilon",
    "Termination Cost": "objective.advantages.termination_cost",
    "beta KL Regularizer": "objective.loss.kl_coeff",
}
METHODS = sorted({path.stem for path in (Path(conf.__file__).parent / "method").glob("*.yaml")} & set(TABLES))


def setting(cfg, path):
    for key in path.split("."):
        cfg = cfg[key]
    return cfg


@pytest.mark.parametrize("stage", ["pretrain", "transfer"])
@pytest.mark.parametrize("method", METHODS)
def test_the_paper_preset_holds_the_table_of_each_method(method, stage):
    task = {"pretrain": "imitation", "transfer": "heading"}[stage]
    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        cfg = compose("train", ["preset=paper", f"method={method}", f"stage={stage}", f"task={task}"])
    assert cfg.optimizer.actor["_target_"] == cfg.optimizer.critic["_target_"] == "torch.optim.SGD"
    assert cfg.optimizer.critic.momentum == cfg.optimizer.actor.momentum
    assert cfg.stage.gamma == DISCOUNT[stage]
    other = {"pretrain": "(Transfer)", "transfer": "(Pre-Train)"}[stage]
    for row, values in TABLES[method].items():
        if row.endswith(other):
            continue
        for character, value in zip(CHARACTERS, values, strict=False):
            cfg.character.name = character
            assert setting(cfg, SETTINGS[row]) == value, (row, character)
        if method != "hierarchical":
            # No table has the ant: it takes the biped's values. The paper has no hierarchical model of it.
            cfg.character.name = "ant"
            assert setting(cfg, SETTINGS[row]) == values[0], (row, "ant")
