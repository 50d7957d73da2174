"""Run folders that are moved, and files outside them."""

import csv
import json
import shlex
import shutil
from pathlib import Path

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from torchrl_mcp.envs.motions.trex import trex_corpus
from torchrl_mcp.runs import identity, places, quoting

FAST = ["preset=smoke", "num_threads=1", "progress_bar=false", "width=0.05", "evaluation.episodes=0"]
SHORT = [*FAST, "method=scratch", "training.total_frames=128"]
NASTY = ["a=b[1]", "größe", "two words, it's", 'say "x"', "back\\slash\\", "{x}$HOME", "1e5"]


@pytest.fixture(scope="module")
def begun(command, tmp_path_factory):
    """Folder ``a`` with a run of one batch in ``run``, and an empty folder ``b``."""
    root = tmp_path_factory.mktemp("places")
    (root / "a").mkdir()
    (root / "b").mkdir()
    outcome = command("train", *SHORT, "logger=csv", "run_dir=run", cwd=root / "a")
    assert outcome.returncode == 0, outcome.stderr
    return root


@pytest.fixture
def root(begun, tmp_path):
    return shutil.copytree(begun, tmp_path / "root")


def learnt(run):
    """What a run has learnt from: its metrics but times."""
    with (run / "metrics.csv").open() as file:
        return [
            {key: row[key] for key in row if not key.startswith(("time/", "seconds"))} for row in csv.DictReader(file)
        ]


def steps_logged(run):
    (file,) = run.rglob("reward.csv")
    return [int(line.split(",")[0]) for line in file.read_text().splitlines()]


def test_a_longer_run_goes_on_from_another_folder_after_a_move_as_one_that_was_planned(root, command):
    outcome = command("train", "resume=../a/run", "training.total_frames=256", cwd=root / "b")
    assert outcome.returncode == 0, outcome.stderr
    assert list((root / "b").iterdir()) == []
    assert steps_logged(root / "a/run") == [128, 256]
    shutil.move(root / "a/run", root / "moved")
    outcome = command("train", "resume=moved", "training.total_frames=384", cwd=root)
    assert outcome.returncode == 0, outcome.stderr
    assert list((root / "a").iterdir()) == []
    assert steps_logged(root / "moved") == [128, 256, 384]
    extended = json.loads((root / "moved/origin.json").read_text())["extended"]
    assert [(one["planned"], one["total_frames"], one["after"]) for one in extended] == [
        (128, 256, 128),
        (256, 384, 256),
    ]
    planned = [*SHORT[:-1], "training.total_frames=384", "logger=none", "run_dir=planned"]
    assert command("train", *planned, cwd=root).returncode == 0
    assert learnt(root / "moved") == learnt(root / "planned")


def test_motions_are_found_from_every_folder_and_missed_by_the_name_of_their_setting(tmp_path, command):
    (tmp_path / "a/clips").mkdir(parents=True)
    trex_corpus()[0].save(tmp_path / "a/clips/walk.npz")
    motions = [
        "task=imitation",
        "character=trex",
        "method=finetune",
        "motions=folder",
        "motions.path=clips",
        "run_dir=run",
    ]
    assert command("train", *FAST, *motions, "training.total_frames=128", cwd=tmp_path / "a").returncode == 0
    evaluation = ["evaluate", tmp_path / "a/run", "--episodes", "1"]
    assert command(*evaluation, cwd=tmp_path).returncode == 0
    (tmp_path / "a/clips").rename(tmp_path / "elsewhere")
    missed = command(*evaluation, cwd=tmp_path)
    assert f"motions.path={tmp_path / 'a/clips'} does not exist" in missed.stderr
    assert command(*evaluation, "--task", "clips.path=elsewhere", cwd=tmp_path).returncode == 0
    longer = ["train", "resume=a/run", "training.total_frames=256"]
    assert "+motions.path=PATH" in command(*longer, cwd=tmp_path).stderr
    outcome = command(*longer, "+motions.path=elsewhere", cwd=tmp_path)
    assert outcome.returncode == 0, outcome.stderr
    assert command(*evaluation, cwd=tmp_path / "a").returncode == 0


@pytest.mark.parametrize("name", ["a=b[1]", "größe, it's two words", "{x}$HOME"])
def test_what_is_printed_runs_in_a_folder_of_any_name(root, command, name):
    folder = (root / "a/run").rename(root / name)
    refusal = command("train", *SHORT, "logger=none", quoting.setting("run_dir", name), cwd=root)
    printed = refusal.stderr.partition("continue it with ")[2].partition(", or give")[0]
    program, *words = shlex.split(printed)
    outcome = command(program.removeprefix("torchrl-mcp-"), *words, cwd=root)
    assert outcome.returncode == 0, outcome.stderr
    assert "is complete" in outcome.stdout
    (play, *_) = [line for line in outcome.stdout.splitlines() if line.startswith("  torchrl-mcp-play")]
    assert root / shlex.split(play)[1] == folder


@pytest.mark.parametrize(
    "value", [*NASTY, "", "null", "a\\\\\"b'", "~x", " x ", "a:b", "100%", "a|b&c;d", ".inf", "-1", "@x"]
)
def test_a_quoted_value_is_read_by_hydra_as_it_is(value):
    (override,) = OverridesParser.create().parse_overrides([quoting.setting("run_dir", value)])
    assert override.value() == value


def test_folders_of_other_networks_have_other_names_wherever_those_are(root):
    first, moved = root / "a/run", root / "moved"
    shutil.copytree(first, moved)
    name = identity.folder_name("x-1", str(first))
    assert name == identity.folder_name("x-1", str(moved)) != identity.folder_name("x-1", None) == "x-1"
    (newest,) = (path for path in (moved / "checkpoints").iterdir() if "128" in path.name)
    newest.unlink()  # its first networks are the newest now
    assert identity.folder_name("x-1", str(moved)) != name


def test_a_damaged_checkpoint_is_refused_as_such(root, command):
    (root / "damaged.torchrl").write_bytes(b"no checkpoint")
    outcome = command("train", *SHORT, "task=holdout", "stage=pretrain", "pretrained=damaged.torchrl", cwd=root)
    assert outcome.returncode
    assert "damaged.torchrl is damaged, or is not a checkpoint" in outcome.stderr


def test_long_names_are_shortened_and_stay_different():
    names = {identity.folder_name("_".join(f"optimizer.x{i}-{i + end}" for i in range(30)), None) for end in (0.1, 0.2)}
    assert len(names) == 2
    assert all(len(name) <= identity.LONGEST for name in names)


def test_a_stored_configuration_has_no_place_but_absolute_ones(begun):
    text = (begun / "a/run/config.yaml").read_text()
    config = yaml.safe_load(text)
    assert (config["run_dir"], config["logger"]["logger_name"]) == (".", ".")
    assert str(begun) not in text


def test_a_resumed_run_takes_new_places_of_its_files_and_no_path_of_a_function_of_ones_own(tmp_path, command):
    (tmp_path / "run").mkdir()
    config = {"_target_": "own_module.motions", "path": "clips"}
    library = {"_target_": places.FOLDER_LIBRARY, "path": "clips"}
    text = yaml.safe_dump({"training": {"total_frames": 1}, "own": config, "motions": library})
    (tmp_path / "run/config.yaml").write_text(text)
    refused = command("train", "resume=run", "+own.path=other", "+motions.path=others", cwd=tmp_path)
    assert refused.returncode
    assert "leave out +own.path=other" in refused.stderr
    assert "motions.path" in refused.stderr.partition(": leave out")[0]
    assert (tmp_path / "run/config.yaml").read_text() == text


@pytest.mark.parametrize("function", ["hydra.utils.get_class", "hydra.utils.get_method", "own_module.mixer"])
def test_only_the_path_of_a_folder_of_motions_is_a_place(function):
    config = {"made": {"_target_": function, "path": "torch.nn.Linear"}, "pretrained": "builtin"}
    assert places.outside(config) == {}
    assert places.stored(OmegaConf.create(config)) == {**config, "run_dir": ".", "run_root": "."}
    motions = {"_target_": "torchrl_mcp.envs.motions.corpus.folder_library", "path": "clips"}
    assert places.stored(OmegaConf.create({"motions": motions}))["motions"]["path"] == str(Path("clips").absolute())
