import json
import math
import pickle
import re
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from torchrl_mcp.commands import motions
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.motions.capture import paper_corpus
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.gait.generator import stride
from torchrl_mcp.envs.motions.trex import trex_walk

COLUMNS = [0.1, 0.0, 0.9, 0.0, *[1.0, 0, 0, 0] * 4, -0.2, *[1.0, 0, 0, 0] * 2, 0.4, *[1.0, 0, 0, 0], -0.1]
COLUMNS += [*[1.0, 0, 0, 0] * 2, 0.3]
"""A frame of DeepMimic's: standing with the joints a little bent."""


def motion(seconds, loop="none", speed=1.0):
    frames = [[0.1, speed * index / 10, *COLUMNS[2:]] for index in range(round(seconds * 10) + 1)]
    return json.dumps({"Loop": loop, "Frames": frames})


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Call the program in an empty folder; return status, output and errors."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        status, error = 0, ""
        try:
            motions.main([*map(str, words)])
        except SystemExit as end:
            status, error = (1, f"{end.code}\n") if isinstance(end.code, str) else (end.code, "")
        captured = capsys.readouterr()
        return status, captured.out, captured.err + error

    return run


def test_import_replaces_no_recording(run, tmp_path):
    for name in ("walk.npz", "own/walk.npz", "clip_mirrored.npz"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        np.savez(tmp_path / name, note="the only copy")
    (tmp_path / "walk.txt").write_text(motion(1.0))
    (tmp_path / "clip.txt").write_text(motion(1.0))
    assert run("import", "clip.txt")[0] == 0
    assert run("import", "clip.txt")[0] == 0  # again
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.npz")}
    for words in (["walk.txt"], ["walk.txt", "--output", "own"], ["clip.npz"], ["clip.txt", "--mirror"]):
        status, _, errors = run("import", *words)
        assert "is a recording that the clip would replace: pass another --output" in f"{status}{errors}"
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.npz")} == before


def test_a_clip_that_cannot_be_written_leaves_the_one_before(run, tmp_path, monkeypatch):
    (tmp_path / "walk.txt").write_text(motion(1.0))
    run("import", "walk.txt")
    before = (tmp_path / "walk.npz").read_bytes()

    def full(clip, file):
        file.write(b"half")
        raise OSError("no space left on the device")

    monkeypatch.setattr(MotionClip, "save", full)
    assert run("import", "walk.txt")[0] != 0
    assert [path.name for path in tmp_path.glob("*.npz*")] == ["walk.npz"]
    assert (tmp_path / "walk.npz").read_bytes() == before


def test_a_file_that_cannot_be_read_keeps_no_other_from_being_written(run, tmp_path):
    for name in ("first", "last"):
        (tmp_path / f"{name}.txt").write_text(motion(1.0))
    (tmp_path / "cut.txt").write_text(motion(1.0)[:100])
    (tmp_path / "empty.bvh").write_text("")
    status, output, errors = run("import", "first.txt", "cut.txt", "empty.bvh", "last.txt", "--output", "clips")
    assert status == 1
    assert {path.name for path in (tmp_path / "clips").iterdir()} == {"first.npz", "last.npz"}
    assert [line.split()[0] for line in output.splitlines()[1:4]] == ["first", "last", "total"]
    first, *others = errors.splitlines()
    assert first == "torchrl-mcp-motions: 2 of 4 files were left out:"
    assert ["cut.txt" in others[0], "empty.bvh" in others[1]] == [True, True]
    status, output, errors = run("inspect", "cut.txt", "last.txt")
    assert (status, output.splitlines()[1].split()[0]) == (1, "last")
    assert errors.startswith("torchrl-mcp-motions: 1 of 2 files were left out:\ncut.txt")


def test_files_that_are_too_short_are_named(run, tmp_path):
    for name, seconds in (("long", 2.0), ("short", 0.2), ("brief", 0.2)):
        (tmp_path / f"{name}.txt").write_text(motion(seconds))
    errors = run("import", "long.txt", "short.txt", "brief.txt", "--rate", 2)[2]
    assert "\nshort.txt, brief.txt: rate=2.0 leaves less than two frames of 0.2 s" in errors


def test_an_argument_that_is_wrong_for_all_files_is_named_once(run, tmp_path):
    for name in ("first", "last"):
        (tmp_path / f"{name}.txt").write_text(motion(1.0))
    status, output, errors = run("import", "first.txt", "last.txt", "--character", "lizard")
    assert (status, output, errors.count("lizard"), len(errors.splitlines())) == (1, "", 1, 1)


def test_import_writes_clips_and_says_what_they_are_like(run, tmp_path):
    (tmp_path / "walk.txt").write_text(motion(2.0, speed=0.5))
    (tmp_path / "stroll.json").write_text(motion(1.0, speed=0.3))
    status, output, errors = run("import", "walk.txt", "stroll.json", "--mirror", "--output", "clips", "--rate", 20)
    assert (status, errors) == (0, "")
    clips = {path.stem: MotionClip.load(path) for path in (tmp_path / "clips").iterdir()}
    assert set(clips) == {"walk", "walk_mirrored", "stroll", "stroll_mirrored"}
    assert clips["walk"].fps == pytest.approx(20)
    assert torch.equal(clips["walk_mirrored"].qpos, clips["walk"].mirrored().qpos)
    lines = output.splitlines()
    measured = ["walk", "humanoid", "2.00", "20", "0.50", "0.00", "-", "-", "0.0", "deg,", "0", "%"]
    measured += ["0.0", "deg", "0.0", "cm", "0.0", "cm"]
    assert lines[1].split()[:-2] == measured
    assert lines[1].split()[-1] == "-"  # joints of the character itself have no rest pose
    assert lines[3].split()[4] == "0.30"
    assert [line.split()[0] for line in lines[2:5]] == ["walk_mirrored", "stroll", "stroll_mirrored"]
    assert lines[5].split() == ["total", "6.0"]
    assert lines[6].startswith("In walk, walk_mirrored, no part of the body rests")  # it glides without a step
    assert lines[-1] == "written to clips"


def test_a_mirror_image_replaces_no_other_clip(run, tmp_path):
    for name, length in (("walk", 1.0), ("walk_mirrored", 2.0)):
        (tmp_path / f"{name}.txt").write_text(motion(length))
    status, output, errors = run("import", "walk.txt", "walk_mirrored.txt", "--mirror", "--output", "clips")
    assert (status, output) == (1, "")
    assert "a file and a mirror image are both called walk_mirrored: leave the file out, or --mirror" in errors
    assert not (tmp_path / "clips").exists()
    assert run("import", "walk.txt", "walk_mirrored.txt", "--output", "clips")[0] == 0


def test_clips_and_recordings_can_be_inspected(run, tmp_path):
    (tmp_path / "walk.txt").write_text(motion(1.0, "wrap"))
    run("import", "walk.txt", "--character", "biped")
    status, output, _ = run("inspect", "walk.npz")
    assert status == 0
    assert output.splitlines()[1].split()[:5] == ["walk", "biped", "1.00", "30", "loop"]
    of_recording = run("inspect", "walk.txt", "--character", "biped")[1]
    recorded, glides = (
        [line for line in text.splitlines() if not line.startswith("In walk,")] for text in (of_recording, output)
    )
    assert "\n".join(recorded).replace("0.0 deg, 0 %", "-").split() == "\n".join(glides).split()  # a clip has no cut
    assert {path.name for path in tmp_path.iterdir()} == {"walk.txt", "walk.npz"}


def test_a_clip_reaches_a_character_of_a_module_with_the_bodies_that_are_printed(run, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "lizard", raising=False)
    monkeypatch.setitem(CHARACTERS, "lizard", None)  # is taken out again afterwards
    (tmp_path / "lizard.py").write_text(
        "from dataclasses import replace\n"
        "from torchrl_mcp.envs.characters import CHARACTERS, TREX\n"
        "CHARACTERS['lizard'] = replace(TREX, key_bodies=('head',))\n"
    )
    (tmp_path / "bodies.yaml").write_text("neck: upper_neck")
    stride("humanoid", 1.0, 0.0, strides=1).save("walk.npz")
    words = ("import", "walk.npz", "--character", "lizard", "--module", "lizard", "--output", "clips")
    status, output, errors = run(*words, "--bodies", "bodies.yaml")
    assert (status, errors) == (0, "")
    assert "lizard follows with root: root, chest: chest, right_hip: right_hip" in output
    assert "neck: upper_neck" in output
    assert re.search(r"Bones miss their directions in walk by \d+\.\d deg in the median", output)
    assert MotionClip.load(tmp_path / "clips" / "walk.npz").character == "lizard"
    assert "follows" not in run("inspect", "clips/walk.npz", "--module", "lizard")[1]


def test_without_a_human_body_there_is_no_table_of_strides(run):
    trex_walk(1.0, 0.0).save("trex.npz")
    status, output, errors = run("inspect", "trex.npz", "--strides")
    assert (status, errors) == (0, "")
    assert output.splitlines()[-1].startswith("no strides: ")


def test_inspect_shows_the_strides_of_people_if_asked_to(run):
    stride("humanoid", 1.0, 0.0, strides=8).save("walk.npz")
    stride("biped", 0.8, 0.5, strides=8).save("turn.npz")
    trex_walk(1.0, 0.0).save("trex.npz")
    assert "steps/min" not in run("inspect", "walk.npz")[1]
    status, output, errors = run("inspect", "walk.npz", "turn.npz", "trex.npz", "--strides")
    assert (status, errors) == (0, "")
    header, walk, turn = output.split("\n\n")[1].splitlines()
    assert header.split()[:6] == ["clip", "strides", "length", "m", "steps/min", "width"]
    name, strides, length, cadence, width, stance, double_support, *_ = walk.split()
    assert name == "walk"
    assert int(strides) >= 10
    assert float(length) == pytest.approx(1.0 / 0.86, rel=0.02)  # 0.86 strides per second at 1 m/s
    assert float(cadence) == pytest.approx(120 * 0.86, rel=0.02)
    assert float(width) == pytest.approx(0.12, abs=0.01)
    assert float(double_support) == pytest.approx(2 * float(stance) - 1, abs=0.02)
    assert turn.split()[-1] == "-"  # without arms


def test_suffixes_may_be_capital_and_lists_may_have_blanks(run, tmp_path):
    trex_walk(1.0, 0.0).save("walk.npz")
    (tmp_path / "walk.npz").rename(tmp_path / "WALK.NPZ")
    assert run("inspect", "WALK.NPZ")[1].splitlines()[1].split()[:2] == ["WALK", "trex"]
    clip = stride("biped", 1.0, 0.3, strides=1)
    np.savetxt("walk.csv", clip.qpos.numpy(), delimiter=",")
    words = ("walk.csv", "--character", "biped", "--fps", clip.fps, "--joints", ", ".join(clip.layout.names[1:]))
    assert run("inspect", *words)[::2] == (0, "")


def test_a_clip_without_strides_is_said_to_have_none(run, tmp_path):
    (tmp_path / "stand.txt").write_text(motion(1.0, speed=0.0))
    assert run("inspect", "stand.txt", "--strides")[1].splitlines()[-1].split() == ["stand", "0", *["-"] * 10]


def test_import_says_how_far_the_rest_pose_is_from_standing(run, mocap):
    lines = run("inspect", mocap / "cmu" / "02_01.amc")[1].splitlines()
    assert lines[0].endswith("rest pose leans")
    assert float(lines[1].split()[-2]) < 10
    striding = run("inspect", mocap / "cmu" / "02_01.amc", "--rest-frame", 100)[1].splitlines()[1]
    assert float(striding.split()[-2]) > 30


def test_render_draws_a_sheet_and_a_film(run, tmp_path):
    (tmp_path / "walk.txt").write_text(motion(1.0))
    status, output, errors = run("render", "walk.txt", "--output", "pictures", "--seconds", 0.2)
    if "no OpenGL" in errors:
        pytest.skip(errors)
    assert status == 0
    assert output.split() == ["pictures/walk.png", "pictures/walk.gif"]
    with (
        Image.open(tmp_path / "pictures" / "walk.png") as sheet,
        Image.open(tmp_path / "pictures" / "walk.gif") as film,
    ):
        assert sheet.size == (1600, 600)
        assert film.n_frames in range(1, 6)  # equal frames are merged


def test_a_motion_whose_feet_slide_is_pointed_out(run, tmp_path):
    """One foot glides past the other at 1.5 m/s, and neither stands."""
    frames = json.loads(motion(2.0, speed=1.5))
    for index, columns in enumerate(frames["Frames"]):
        angle = 0.3 * (-1) ** index
        columns[16:20] = [math.cos(angle), 0.0, 0.0, math.sin(angle)]
    (tmp_path / "skate.txt").write_text(json.dumps(frames))
    assert run("inspect", "skate.txt")[1].splitlines()[-1].startswith("The feet slide in skate: unit, frame rate,")


def test_a_body_that_hovers_along_is_pointed_out(run, tmp_path):
    (tmp_path / "ghost.txt").write_text(motion(2.0, speed=1.0))
    (tmp_path / "statue.txt").write_text(motion(2.0, speed=0.0))
    lines = run("inspect", "ghost.txt", "statue.txt")[1].splitlines()
    assert lines[-1].startswith("No part of the body rests on the ground in ghost: unit, frame rate,")


def test_the_table_shows_how_high_standing_soles_are(run):
    walk = stride("humanoid", 1.0, 0.0, strides=2)
    walk.save("walk.npz")
    qpos = walk.qpos.clone()
    qpos[:, 2] += 0.04
    MotionClip("humanoid", qpos, walk.fps).save("hovers.npz")
    header, *rows = run("inspect", "walk.npz", "hovers.npz")[1].splitlines()
    column = header.index("standing soles")
    shown = [float(row[column:].split()[0]) for row in rows[:2]]
    assert shown[1] - shown[0] == pytest.approx(4.0, abs=0.11)
    assert abs(shown[0]) < 0.5


def test_pickles_are_not_read_and_their_conversion_is_named(run, tmp_path):
    (tmp_path / "dance.pkl").write_bytes(pickle.dumps({"smpl_poses": [], "smpl_trans": [], "smpl_scaling": [1.0]}))
    status, output, errors = run("import", "dance.pkl", "--output", "clips")
    assert (status, output) == (1, "")
    for word in ("dance.pkl", "AISTDataset.load_motion", "numpy.savez", ".npz", "smpl_scaling"):
        assert word in errors
    assert "rename" not in errors
    assert not (tmp_path / "clips").exists()


def standing(turn):
    """A person who stands along y in all frames, and along z before the root is turned about x."""
    channels = "CHANNELS 3 Zrotation Yrotation Xrotation"
    side = "".join(
        f"JOINT {name}UpLeg {{\nOFFSET {x} 0 0\n{channels}\nJOINT {name}Leg {{\nOFFSET 0 0 -43\n{channels}\n"
        f"JOINT {name}Foot {{\nOFFSET 0 0 -42\n{channels}\n}} }} }}\n"
        for name, x in (("Left", 9), ("Right", -9))
    )
    root = f"ROOT Hips {{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition {channels[11:]}\n"
    spine = f"JOINT Spine {{\nOFFSET 0 0 20\n{channels}\n}} }}\n"
    row = f"0 92 0 0 0 {turn}{' 0' * 21}\n"
    return f"HIERARCHY\n{root}{side}{spine}MOTION\nFrames: 9\nFrame Time: 0.0333\n{9 * row}"


def test_what_was_assumed_about_the_vertical_is_said(run, tmp_path):
    (tmp_path / "stand.bvh").write_text(standing(-90))
    words = ["stand.bvh", "--character", "biped", "--map", "chest=Spine"]
    status, output, errors = run("import", *words)
    assert (status, errors) == (0, "")
    assert "Assumed for stand: y points up, and the rest pose is turned by 90 degrees to stand along it" in output
    clip = MotionClip.load("stand.npz")
    assert clip.qpos[:, 2].min() > 0.8
    assert "Assumed" not in run("inspect", *words, "--up", "y")[1]


def corpus(folder, **seconds):
    """The files of the paper's corpus, in which nobody moves a limb."""
    (folder / "deep").mkdir(parents=True)
    for name, duration in {**paper_corpus.DURATIONS, **seconds}.items():
        if name.endswith(".txt"):
            loop = "wrap" if name == "humanoid3d_walk.txt" else "none"
            (folder / "deep" / name).write_text(motion(duration, loop, speed=0.1))


def test_the_papers_corpus_lacks_what_was_not_downloaded(run, tmp_path):
    corpus(tmp_path / "downloads")
    status, _, errors = run("build-paper-corpus", "downloads")
    assert status == 1
    assert errors.startswith(
        "torchrl-mcp-motions: downloads lacks\n  0005_Walking001.bvh (from https://mocap.cs.sfu.ca"
    )
    assert "humanoid3d" not in errors
    assert not (tmp_path / "corpus").exists()


def test_the_papers_corpus_takes_no_other_motion_of_that_name(run, tmp_path, monkeypatch):
    corpus(tmp_path / "downloads", **{"humanoid3d_long_walk2.txt": 20.0})
    (tmp_path / "downloads" / "0005_Walking001.bvh").write_text("?")
    status, _, errors = run("build-paper-corpus", "downloads")
    assert status == 1
    assert "humanoid3d_long_walk2.txt lasts 20.00 s, and the paper's corpus needs 24.56 s" in errors


@pytest.mark.parametrize("character", ["humanoid", "biped"])
def test_the_papers_corpus_of_real_files_is_230_seconds_and_half_of_it_is_mirrored(run, mocap, tmp_path, character):
    status, output, errors = run("build-paper-corpus", mocap, "--character", character)
    assert (status, errors) == (0, "")
    clips = {path.stem: MotionClip.load(path) for path in (tmp_path / "corpus").iterdir()}
    assert sum(clip.duration for clip in clips.values()) == pytest.approx(229.6, abs=0.05)
    assert ["total", "229.6"] in [line.split() for line in output.splitlines()]
    assert len(clips) == 9
    mirrored = [name for name in clips if name.endswith("_mirrored")]
    assert len(mirrored) == 4
    for name in mirrored:
        assert torch.equal(clips[name].qpos, clips[name.removesuffix("_mirrored")].mirrored().qpos)
    assert "slide in" not in output


WRONG = {
    "no command": ([], "required: command"),
    "no file": (["import"], "required: FILE"),
    "missing file": (["import", "nowhere.bvh"], "torchrl-mcp-motions: there is no file nowhere.bvh"),
    "missing clip": (["inspect", "nowhere.npz"], "torchrl-mcp-motions: .*nowhere.npz"),
    "damaged clip": (["inspect", "broken.npz"], "torchrl-mcp-motions: .*"),
    "unknown kind": (["inspect", "notes.md"], r"notes\.md: must end in \.bvh"),
    "no BVH": (["import", "cut.bvh"], r"cut\.bvh:1: does not begin with HIERARCHY"),
    "needless bodies": (
        ["import", "stand.txt", "--bodies", "bodies.yaml"],
        "bodies do not apply to character=humanoid",
    ),
    "no bodies": (["import", "stand.txt", "--character", "trex", "--bodies", "notes.md"], "notes.md must have lines"),
    "missing bodies": (["import", "stand.txt", "--bodies", "nowhere.yaml"], "nowhere.yaml"),
    "no module": (
        ["import", "stand.txt", "--module", "nowhere"],
        "--module names nowhere, which Python does not find: ",
    ),
    "unknown character": (["import", "stand.csv", "--character", "cat"], "character='cat' does not exist"),
    "no rate": (["import", "stand.csv"], r"stand\.csv: has no frame rate: pass it \(--fps\)"),
    "wrong map": (["import", "cut.bvh", "--map", "left_knee"], "--map: 'left_knee' must have the form PART=JOINT"),
    "wrong option": (["import", "stand.txt", "--scale", "2"], "scale does not apply to stand.txt"),
    "wrong rate": (["import", "stand.txt", "--rate", "0"], "rate=0.0 leaves less than two frames"),
    "no seconds": (["render", "stand.txt", "--seconds", "0"], "'0' must be a duration: pass more than 0 seconds"),
    "endless": (["render", "stand.txt", "--seconds", "inf"], "'inf' must be a duration"),
    "no frames": (["inspect", "stand.txt", "--skip", "-3"], "--skip: '-3' must be a whole number of at least 0"),
    "no Python": (
        ["inspect", "stand.txt", "--module", "broken_code"],
        r"broken_code, which is not valid Python: .*broken_code\.py, line 1",
    ),
    "same name": (["inspect", "stand.txt", "more/stand.txt"], "two files are called stand"),
    "missing folder": (["build-paper-corpus", "nowhere"], "nowhere lacks"),
}


@pytest.mark.parametrize(("words", "message"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said_without_a_traceback(run, tmp_path, words, message):
    (tmp_path / "cut.bvh").write_text("nothing")
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04nothing")
    (tmp_path / "notes.md").write_text("nothing")
    (tmp_path / "broken_code.py").write_text("import (")
    (tmp_path / "bodies.yaml").write_text("chest: chest")
    (tmp_path / "stand.csv").write_text("0,0,1,1,0,0,0\n" * 2)
    (tmp_path / "more").mkdir()
    for path in (tmp_path / "stand.txt", tmp_path / "more" / "stand.txt"):
        path.write_text(motion(1.0))
    status, output, errors = run(*words)
    assert status == (2 if errors.startswith("usage") else 1)
    assert output == ""
    assert re.search(message, errors)
    assert "Traceback" not in errors


def test_help_shows_examples():
    command = [sys.executable, "-m", "torchrl_mcp.commands.motions", "--help"]
    result = subprocess.run(command, capture_output=True, text=True, cwd="/")
    assert result.returncode == 0
    for name in ("import", "inspect", "render", "build-paper-corpus"):
        assert f"torchrl-mcp-motions {name} " in result.stdout
