"""What makes two runs of one, and what does not."""

from pathlib import Path

import pytest
import yaml

from torchrl_mcp import conf
from torchrl_mcp.runs.identity import SAME_RUN, SETTINGS, TRANSFER_ONLY, UNLEARNT, differences, is_among

TRAIN = yaml.safe_load((Path(conf.__file__).parent / "train.yaml").read_text())
GROUPS = {name for group in TRAIN["defaults"] if isinstance(group, dict) for name in group}


def test_every_level_of_a_run_folder_is_in_its_path():
    for setting in ("task", "character", "stage", "method", "seed"):
        assert f"${{{setting}" in TRAIN["run_dir"].replace(".name", "")


@pytest.mark.parametrize("name", [name for name in SETTINGS if not name.startswith(("task.", "budget."))])
def test_every_setting_in_the_table_exists(name):
    first, _, rest = name.partition(".")
    assert name in GROUPS or first in TRAIN
    assert not rest or rest in TRAIN[first]


def test_a_run_goes_on_with_another_conduct_but_with_no_other_setting():
    held = dict.fromkeys([*SAME_RUN, "pretrained", "autocast", "seed", "training"], 0)
    assert differences(held, held) == []
    for name in held:
        found = differences(held, {**held, name: 1})
        assert found == ([] if name in SAME_RUN else [name])


def test_networks_elsewhere_make_no_other_run_but_those_of_the_library_do():
    runs = [{"pretrained": value} for value in ("runs/a", "elsewhere/b", "builtin", None)]
    differing = [bool(differences(runs[0], run)) for run in runs]
    assert differing == [False, False, True, True]


def test_a_setting_that_only_one_of_two_has_makes_them_differ():
    assert differences({"seed": 0}, {"seed": 0, "latent_dim": 8}) == ["latent_dim"]
    assert differences({"seed": 0, "latent_dim": 8}, {"seed": 0}) == ["latent_dim"]


def test_a_setting_is_among_others_with_all_that_is_below_it_and_nothing_that_begins_alike():
    assert is_among("evaluation.episodes", UNLEARNT)
    assert is_among("task.evaluation.clip_end", UNLEARNT)
    assert not is_among("task.transfer.speed", UNLEARNT)
    assert not is_among("seeds", UNLEARNT)


def test_pretraining_ignores_nothing_that_it_learns_from():
    assert not any(
        is_among(name, TRANSFER_ONLY) for name in ("training.total_frames", "num_primitives", "budget.pretrain")
    )
