"""What is wrong with a file of DeepMimic is said with its line, and no damage raises another error."""

import json
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_mcp.envs.motions.capture import textfile
from torchrl_mcp.envs.motions.capture.importer import import_motion
from torchrl_mcp.envs.motions.errors import MotionFormatError

BALL, HINGE = [1.0, 0.0, 0.0, 0.0], [0.0]
SIDE = BALL + HINGE + BALL + BALL + HINGE  # hip, knee, ankle, shoulder, elbow
POSE = 3 * BALL + 2 * SIDE  # root, chest, neck, and both sides of the humanoid
STANDING = [[0.1, 0.0, 0.9, 0.0, *POSE]] * 3
JUMP = [STANDING[0], *[[0.1, 9, 1, 0, *POSE]] * 2]


def lines(frames):
    """JSON with one frame a line, the first on line 3."""
    rows = ",\n".join(json.dumps(columns) for columns in frames)
    return '{"Loop": "none",\n"Frames": [\n' + rows + "\n]}\n"


def damaged(column, value, which=1):
    frames = [list(columns) for columns in STANDING]
    frames[which][column] = value
    return lines(frames)


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "motion.txt"
        path.write_text(text)
        return path

    return write


WRONG = {
    "empty": ("", 1, "must be JSON"),
    "truncated": (lines(STANDING)[:-40], 5, "must be JSON"),
    "binary": ("\x00\x01", 1, "must be JSON"),
    "list": ("[1, 2]", 1, "no list of two or more"),
    "no frames": ('{"Loop": "none"}', 1, "no list of two or more"),
    "frames no list": ('{"Frames": 3}', 1, "no list of two or more"),
    "one frame": (lines(STANDING[:1]), 1, "no list of two or more"),
    "unknown loop": (lines(STANDING).replace("none", "sometimes"), 1, "'sometimes'"),
    "loop a list": (lines(STANDING).replace('"none"', "[1]"), 1, "Loop"),
    "other character": (lines([columns[:36] for columns in STANDING]), 3, "the first frame has 36 numbers"),
    "frames of words": ('{"Frames":\n["a", "b"]}', 1, "the first frame has 0 numbers"),
    "truncated row": (lines([STANDING[0], STANDING[1][:43], STANDING[2]]), 4, "frame 2 must have 44 numbers"),
    "row too short for a frame": (lines([STANDING[0], [7], STANDING[2]]), 4, "frame 2 must have 44 numbers"),
    "NaN": (damaged(20, float("nan")), 4, "frame 2 holds a value that is not a number"),
    "infinity": (damaged(2, float("inf"), 2), 5, "frame 3 holds a value that is not a number"),
    "overflow": (lines(STANDING).replace("0.9", "1e999", 1), 3, "frame 1 holds a value that is not a number"),
    "absurd number": (damaged(2, 10**400), 4, "frame 2 holds a value that is not a number"),
    "word": (damaged(2, "high"), 4, "frame 2 holds a value that is not a number"),
    "boolean": (damaged(2, True), 4, "frame 2 holds a value that is not a number"),
    "null": (damaged(2, None), 4, "frame 2 holds a value that is not a number"),
    "no duration": (damaged(0, 0.0), 4, "frame 2 lasts 0 s"),
    "negative duration": (damaged(0, -0.1), 4, "frame 2 lasts -0.1 s"),
    "endless duration": (damaged(0, 9e6), 4, "frame 2 ends after 9e\\+06 s, more than an hour"),
    "no rotation": (damaged(4, 0.0), 4, "quaternion of the root in frame 2 has length 0"),
    "hardly a rotation": (damaged(4, 0.05), 4, "quaternion of the root in frame 2 has length 0.05"),
    "jump": (lines(JUMP), 4, "the root jumps between frames 1 and 2"),
    "nested": ("[" * 100_000, 1, "must be the JSON of a motion"),
    "digits": ('{"Frames": [[' + "9" * 5000 + "]]}", 1, "must be the JSON of a motion"),
}


@pytest.mark.parametrize(("text", "line", "message"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said_with_file_and_line(write, text, line, message):
    path = write(text)
    with pytest.raises(MotionFormatError, match=message) as caught:
        import_motion(path, "humanoid")
    assert str(caught.value).startswith(f"{path}:{line}: ")


def test_a_file_too_large_to_be_a_motion_is_not_parsed(write, monkeypatch):
    monkeypatch.setattr(textfile, "LARGEST_FILE", 2**20)
    with pytest.raises(MotionFormatError, match="larger than 1 MiB"):
        import_motion(write("[]," * 2**19), "humanoid")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"character": "dodo"}, "character='dodo' does not exist: pass one of"),
        ({"rate": 0}, "rate=0 leaves less than two frames"),
        ({"rate": 1e9}, "rate=1000000000.0 leaves less"),
        ({"fps": float("nan")}, "fps=nan"),
    ],
)
def test_arguments_out_of_range_are_named(write, options, message):
    with pytest.raises(ValueError, match=message):
        import_motion(write(lines(STANDING)), **{"character": "humanoid", **options})


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=5,
)


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 43), VALUES), max_size=3), VALUES, st.integers(0, 3000))
def test_no_damage_raises_another_error(tmp_path_factory, damages, loop, cut):
    frames = [list(columns) for columns in STANDING]
    for which, column, value in damages:
        frames[which][column] = value
    path = tmp_path_factory.getbasetemp() / "damaged.txt"
    path.write_text(json.dumps({"Loop": loop, "Frames": frames})[: 3000 - cut])
    with suppress(MotionFormatError):
        import_motion(path, "humanoid")
    path.write_text(json.dumps({"Loop": "wrap", "Frames": frames}))
    with suppress(MotionFormatError):
        import_motion(path, "biped")
