import pytest

from torchrl_mcp.envs.motions import turning_clips
from torchrl_mcp.envs.motions.single import single_motion


@pytest.mark.parametrize(("character", "first"), [("biped", "forward"), ("humanoid", "forward"), ("trex", "straight")])
def test_the_single_motion_is_straight_ahead_unless_another_is_named(character, first):
    library = single_motion(character)
    assert library.names == [first]
    assert library.character == character


def test_a_named_motion_is_the_generated_clip():
    library, clip = single_motion("biped", "right_medium"), turning_clips("biped")["right_medium"]
    assert library.names == ["right_medium"]
    assert library.durations.tolist() == [clip.duration]
    assert library.loops.tolist() == [True]


def test_an_unknown_motion_is_answered_with_those_there_are():
    with pytest.raises(ValueError, match=r"clip='backward'.*'biped'.*'forward'"):
        single_motion("biped", "backward")
