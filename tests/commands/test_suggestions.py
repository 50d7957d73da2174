"""Settings that do not exist are answered with the nearest that do."""

import pytest

from torchrl_mcp.commands.suggestions import suggestions


@pytest.mark.parametrize(
    ("argument", "meant"),
    [
        ("num_primitivs=4", "num_primitives"),
        ("trainig.num_envs=64", "training.num_envs"),
        ("mixr=additive", "mixer"),
        ("objective.loss.clip_epsilom=0.1", "objective.loss.clip_epsilon"),
        ("hydra.swep.dir=runs", "hydra.sweep.dir"),
    ],
)
def test_an_unknown_setting_is_answered_with_the_nearest_that_exist(argument, meant):
    (line,) = suggestions([argument])
    key, _ = argument.split("=")
    assert line.startswith(f"'{key}' is not a setting")
    assert line.split("the nearest are: ")[1].split(", ")[0] == meant


@pytest.mark.parametrize(
    ("arguments", "written"),
    [
        (["imitation.switch_to=same"], "+imitation.switch_to="),
        (["task=heading", "task.transfer.terminate_on_fall=false"], "+task.transfer.terminate_on_fall="),
        (["critic.num_cells=[16]"], "+critic.num_cells="),
    ],
)
def test_an_argument_that_no_file_names_is_answered_with_a_plus(arguments, written):
    (line,) = suggestions(arguments)
    assert written in line
    assert suggestions([*arguments[:-1], f"+{arguments[-1]}"]) == []


def test_a_setting_like_no_other_is_answered_with_how_to_list_all():
    (line,) = suggestions(["qqqqqqqq=1"])
    assert line == "'qqqqqqqq' is not a setting of this method: torchrl-mcp-train --cfg job prints all"


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["method=scratch", "preset=smoke", "seed=3", "training.num_envs=8", "stage.gamma=0.9"],
        ["mixer=additive,multiplicative", "seed=range(3)", "--multirun"],
        ["hydra.run.dir=out"],
        ["+note=new"],
        ["~logger"],
        pytest.param(["method=scratch", "parts.policy.std=0.2"], id="a setting of another method"),
    ],
)
def test_settings_that_exist_are_left_alone(arguments):
    assert suggestions(arguments) == []


def test_only_the_unknown_among_several_are_answered():
    lines = suggestions(["method=scratch", "parts.polcy.std=0.2", "seed=1", "sead=2"])
    assert [line.split("'")[1] for line in lines] == ["parts.polcy.std", "sead"]
    assert "parts.policy.std" in lines[0]


@pytest.mark.parametrize("arguments", [["mixer"], ["a=[1,"], ["method=no_such", "sead=2"]])
def test_what_hydra_cannot_parse_is_left_to_hydra(arguments):
    assert suggestions(arguments) == []
