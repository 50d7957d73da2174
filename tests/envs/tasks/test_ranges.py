import math

import pytest
import torch
from refusals import refused

from torchrl_mcp.envs import Dribble
from torchrl_mcp.envs.tasks.ranges import Ranges

WIDE = {"distances": (1.0, 9.0), "directions": (-3.0, 3.0)}


def draw(ranges, num=2000):
    return ranges.draw(num, torch.Generator().manual_seed(0))


def test_what_is_drawn_fills_its_range_evenly():
    drawn = draw(Ranges(WIDE))
    for name, (low, high) in WIDE.items():
        share = (drawn[name] - low) / (high - low)
        assert 0 <= share.min() < 0.01
        assert 0.99 < share.max() <= 1
        assert (torch.histc(share, 4, 0, 1) - 500).abs().max() < 4.5 * math.sqrt(2000 * 0.25 * 0.75)
    assert torch.corrcoef(torch.stack(list(drawn.values())))[0, 1].abs() < 4.5 / math.sqrt(2000)


def test_alternatives_replace_some_ranges_and_are_drawn_with_the_shares_of_their_weights():
    near = {"weight": 3, "distances": (0.0, 0.5)}
    drawn = draw(Ranges(WIDE, [near, {"directions": (0.0, 0.0)}]))
    is_near = drawn["distances"] <= 0.5
    assert is_near.sum().item() == pytest.approx(1500, abs=4.5 * math.sqrt(2000 * 0.25 * 0.75))
    assert drawn["distances"][~is_near].min() >= 1
    assert (drawn["directions"][~is_near] == 0).all()
    assert drawn["directions"][is_near].std().item() == pytest.approx(6 / math.sqrt(12), rel=0.1)


def test_a_range_without_width_is_a_number_and_nothing_can_be_drawn():
    assert (draw(Ranges({"speed": (2.0, 2.0)}), 3)["speed"] == 2).all()
    assert draw(Ranges(WIDE), 0)["distances"].shape == (0,)


def test_distances_are_kept_clear_in_all_alternatives():
    ranges = Ranges(WIDE, [{"distances": (0.0, 2.0)}, {}])
    ranges.keep_clear("distances", 1.5)
    assert draw(ranges)["distances"].min() >= 1.5
    refused(lambda: ranges.keep_clear("distances", 2.5), "distances=(1.5, 2.0)", "2.50")


@pytest.mark.parametrize(
    ("mixture", "name"),
    [
        ([{"speed": (0, 1)}], "'speed'"),
        ([{"weight": 0.0}], "mixture"),
        ([{"weight": math.inf}, {}], "mixture"),
        ([{"distances": (2, 1)}], "distances=(2, 1)"),
    ],
)
def test_wrong_mixtures_are_refused(mixture, name):
    refused(lambda: Ranges(WIDE, mixture), name)


def test_the_objects_of_a_task_lie_where_the_directions_say(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    near = {"object_distances": (1.0, 2.0), "object_directions": (0.2, 0.4), "target_directions": (-0.5, -0.3)}
    mixture = [{**near, "target_distances": (1.0, 1.0)}]
    env = Dribble("biped", 100, seed=0, num_threads=1, curriculum={"mixture": mixture})
    env.reset()
    state = env.get_state()
    place = state["qpos"][:, -7:-5]
    way = state["mocap_pos"][:, 0, :2] - place
    first, second = (torch.atan2(vector[:, 1], vector[:, 0]) for vector in (place, way))
    assert ((first >= 0.2) & (first <= 0.4)).all()
    assert ((second - first >= -0.5 - 1e-9) & (second - first <= -0.3 + 1e-9)).all()
    torch.testing.assert_close(way.norm(dim=-1), torch.ones(100, dtype=torch.float64))
