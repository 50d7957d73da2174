"""The command on tiny untrained checkpoints, one per method, and on networks that come with the library."""

import csv
import shutil
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from omegaconf import OmegaConf

from torchrl_mcp.analysis import checkpoints, exploration, walk_cycle
from torchrl_mcp.commands import figures
from torchrl_mcp.envs.motions.single import single_motion
from torchrl_mcp.runs import build, policies
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.runs.publish import publish

ANT = ["task=holdout", "task.pretrain.max_episode_steps=6"]
BIPED = ["task=imitation", "character=biped"]


def save(folder, *overrides):
    """Write a run folder of untrained networks, as if it had trained for two iterations."""
    settings = [
        "preset=smoke",
        "logger=none",
        "num_threads=1",
        f"run_dir={folder}",
        "training.total_frames=128",
        *overrides,
    ]
    cfg = compose_run(*settings)
    agent = build.make_agent(cfg, build.make_env(cfg, num_envs=1, seed=0))
    config = OmegaConf.to_container(cfg, resolve=True)
    publish(agent.parts, config, folder / "checkpoints" / "checkpoint-000000000128.torchrl")
    OmegaConf.save(config, folder / "config.yaml")
    with (folder / "metrics.csv").open("w", newline="") as file:
        csv.writer(file).writerows(
            [["frames", "episode/count", "episode/normalised_return"], [64, 2, 0.1], [128, 2, 0.3]]
        )
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Run folders by name."""
    folder = tmp_path_factory.mktemp("runs")
    single, pretrain = [*BIPED, "motions=single"], "stage=pretrain"
    return {
        "mcp": save(folder / "mcp", "method=mcp", pretrain, *single),
        "moe": save(folder / "moe", "method=moe", pretrain, *single),
        "latent": save(folder / "latent", "method=latent_space", pretrain, *single),
        "sequence": save(folder / "sequence", "method=hierarchical", pretrain, *BIPED),
        "options": save(folder / "options", "method=option_critic", pretrain, *single),
        "scratch": save(folder / "scratch", "method=scratch", "task=heading", "character=biped"),
        "ant": save(folder / "ant", "method=mcp", pretrain, *ANT),
        "ant options": save(
            folder / "ant_options", "method=option_critic", pretrain, *ANT, "training.total_frames=256"
        ),
        "ant transfer": save(folder / "ant_transfer", "method=mcp", "stage=transfer", *ANT),
    }


def call(*words):
    figures.main([*map(str, words)])


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def shows_something(stem):
    return imread(f"{stem}.png").std() > 0.01 and Path(f"{stem}.svg").stat().st_size > 1000


def test_two_runs_share_a_figure_of_learning_curves(runs, tmp_path, monkeypatch):
    call("curves", runs["mcp"], runs["moe"], "--output", tmp_path)
    assert shows_something(tmp_path / "curves")
    found = rows(tmp_path / "curves.csv")
    assert {row["label"] for row in found} == {"mcp", "moe"}
    assert max(float(row["mean"]) for row in found) == pytest.approx(0.3)


def test_exploration_has_a_panel_per_checkpoint_and_one_of_noise(runs, tmp_path, monkeypatch, capsys):
    checkpoints = [runs[name] for name in ("mcp", "moe", "latent", "sequence", "options")]
    call("exploration", *checkpoints, "--trajectories", 3, "--seconds", 0.5, "--output", tmp_path)
    assert shows_something(tmp_path / "exploration_biped")
    numbers = rows(tmp_path / "exploration_biped_summary.csv")
    panels = [row["panel"] for row in numbers]
    assert [panel.partition(",")[0] for panel in panels] == [
        "MCP", "MOE", "Latent Space", "Hierarchical", "Option-Critic", "no primitives",
    ]  # fmt: skip
    assert all(panel in capsys.readouterr().out for panel in panels[:1])
    for row in numbers:
        assert int(row["trajectories"]) == 3
        assert 0 < float(row["seconds"]) <= 0.5
    ways = rows(tmp_path / "exploration_biped.csv")
    for panel in panels:
        own = [row for row in ways if row["panel"] == panel]
        assert {row["trajectory"] for row in own} == {"1", "2", "3"}
        start = [(float(row["x"]), float(row["y"])) for row in own if row["seconds"] == "0"]
        assert start == [(0.0, 0.0)] * 3
        # All begin in the same walk: after 0.2 s they have gone some 0.2 m forward, whatever they want to do.
        assert all(0.05 < float(row["x"]) < 0.35 for row in own if row["seconds"] == "0.2")


def test_exploration_works_with_the_ant_and_tells_runs_of_one_method_apart(runs, tmp_path, monkeypatch):
    checkpoints = [tmp_path / "one" / "seed0", tmp_path / "other" / "seed0", runs["ant options"]]
    for name, copy in zip(("ant", "ant transfer"), checkpoints, strict=False):
        shutil.copytree(runs[name], copy)
    call("exploration", *checkpoints, "--trajectories", 2, "--seconds", 0.3, "--output", tmp_path)
    panels = [row["panel"] for row in rows(tmp_path / "exploration_ant_summary.csv")]
    assert panels[:2] == ["MCP, random weights", "MCP, random weights (other-seed0)"]
    assert len(panels) == 4


def test_exploration_repeats_itself_with_the_same_seed(runs, tmp_path, monkeypatch):
    for folder in ("a", "b"):
        settings = ["--trajectories", 2, "--seconds", 0.5, "--seed", 3, "--output", tmp_path / folder]
        call("exploration", runs["mcp"], *settings)
    first, second = ((tmp_path / folder / "exploration_biped.csv").read_bytes() for folder in "ab")
    assert first == second


@pytest.mark.trajectories
def test_primitives_that_come_with_the_library_walk_in_step_with_their_reference(tmp_path, monkeypatch, capsys):
    settings = ["--walkers", 2, "--seconds", 4, "--output", tmp_path]
    call("primitives", "builtin:biped", *settings)
    assert shows_something(tmp_path / "primitives_mcp-biped")
    trained, untrained = rows(tmp_path / "primitives.csv")
    assert (trained["networks"], untrained["networks"]) == ("trained", "untrained")
    stride = single_motion("biped").durations.item()
    assert int(trained["strides"]) == pytest.approx(2 * 4 / stride, abs=3)
    assert float(trained["swing"]) > 10 * float(untrained["swing"])
    assert len(rows(tmp_path / "primitives_mcp-biped.csv")) == 8
    assert len(rows(tmp_path / "primitives_mcp-biped_actions.csv")) % 8 == 0
    weights = rows(tmp_path / "primitives_mcp-biped_weights.csv")
    assert {row["primitive"] for row in weights} == {str(number) for number in range(1, 9)}
    # People who walk never leave the ground, and stand on either foot for more than half of the time.
    for foot in ("right_foot", "left_foot"):
        assert 0.5 < np.mean([float(row[foot]) for row in weights]) < 0.8
    out = capsys.readouterr().out
    assert "mcp-biped" in out
    assert "distinct" in out


def test_holdout_draws_trajectories_by_direction_and_curves(runs, tmp_path, monkeypatch):
    call("holdout", runs["ant"], runs["ant transfer"], runs["ant options"], "--output", tmp_path)
    for name in ("holdout_mcp", "holdout_option_critic", "holdout_curves"):
        assert shows_something(tmp_path / name)
    seen, held_out = (0.0, 4.7124), (4.7124, 6.2832)
    expected = {
        "as pre-trained, on directions it saw": seen,
        "as pre-trained, on held-out directions": held_out,
        "after transfer, on held-out directions": held_out,
    }
    ways = rows(tmp_path / "holdout_mcp.csv")
    assert {row["panel"] for row in ways} == set(expected)
    for panel, (low, high) in expected.items():
        directions = [float(row["direction"]) for row in ways if row["panel"] == panel]
        assert (min(directions), max(directions)) == (low, high)
    unfinished = {row["panel"] for row in rows(tmp_path / "holdout_option_critic.csv")}
    assert unfinished == {"in pre-training, on directions it saw", "in pre-training, on held-out directions"}
    assert {row["label"] for row in rows(tmp_path / "holdout_curves.csv")} == {"MCP"}  # what was transferred


def test_holdout_averages_runs_of_the_same_settings_alone(runs, tmp_path, monkeypatch):
    copies = [shutil.copytree(runs["ant transfer"], tmp_path / f"{i}") for i in range(3)]
    for copy, num_primitives, value in zip(copies, (2, 8, 8), (0.1, 0.5, 0.7), strict=True):
        settings = OmegaConf.load(copy / "config.yaml")
        settings.num_primitives = num_primitives
        OmegaConf.save(settings, copy / "config.yaml")
        metrics = (copy / "metrics.csv").read_text()
        (copy / "metrics.csv").write_text(metrics.replace(",0.1", f",{value}").replace(",0.3", f",{value}"))
    call("holdout", *copies, "--output", tmp_path)
    found = {
        (row["label"], row["seeds"], round(float(row["mean"]), 6)) for row in rows(tmp_path / "holdout_curves.csv")
    }
    assert found == {("MCP, 2 primitives", "1", 0.1), ("MCP", "2", 0.6)}


def test_a_character_of_your_own_has_its_name_in_titles(tmp_path, monkeypatch):
    class Drawn(Exception):
        pass

    def draw(*_, title):
        raise Drawn(title)

    cfg = OmegaConf.create({"method": {"title": "Mine"}, "character": {"name": "spider"}})
    monkeypatch.setattr(figures, "_explored", lambda arguments: ({}, "spider"))
    monkeypatch.setattr(exploration, "draw_exploration", draw)
    monkeypatch.setattr(policies, "policy_config", lambda path: cfg)
    monkeypatch.setattr(checkpoints, "walk_of", lambda *_, **__: (None, {}))
    monkeypatch.setattr(walk_cycle, "draw_walk_cycle", draw)
    shared = {"checkpoints": [tmp_path], "output": tmp_path, "seconds": 1.0, "seed": 0}
    with pytest.raises(Drawn, match="spider, 2 times"):
        figures.explore(Namespace(trajectories=2, **shared))
    with pytest.raises(Drawn, match="Mine, spider, walking"):
        figures.analyse(Namespace(clip=None, walkers=1, **shared))


@pytest.mark.parametrize(
    ("command", "names", "name"),
    [
        ("exploration", ["scratch"], "method=scratch"),
        ("exploration", ["mcp", "ant"], "biped and ant"),
        ("primitives", ["mcp"], "stride"),
        ("primitives", ["latent"], "method=latent_space"),
        ("primitives", ["sequence"], "method=hierarchical"),
        ("primitives", ["ant"], "task=holdout"),
        ("holdout", ["mcp"], "task=imitation"),
        ("exploration", ["mcp", "mcp"], "twice"),
    ],
)
def test_what_cannot_be_drawn_is_refused_by_name(command, names, name, runs, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=name):
        call(command, *(runs[run] for run in names), "--output", tmp_path)
    assert list(tmp_path.iterdir()) == []
