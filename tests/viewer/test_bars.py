import numpy as np
import pytest
from PIL import Image, ImageColor

from torchrl_mcp.analysis.figures import COLOURS, FAINT
from torchrl_mcp.viewer.bars import draw_bars


def drawn(weights, height=440):
    picture = Image.new("RGB", (440, height), "white")
    draw_bars(picture, weights, "gates")
    return np.asarray(picture)


def where(pixels, colour):
    """Rows and columns of a colour."""
    return np.nonzero((pixels == ImageColor.getrgb(colour)).all(-1))


def length(pixels, colour):
    """Of the bar of a colour, in columns: all of its rows are as long."""
    rows, columns = where(pixels, colour)
    return len(np.unique(columns)) if len(rows) == len(np.unique(rows)) * len(np.unique(columns)) else None


@pytest.mark.parametrize("height", [110, 440])
def test_bars_are_as_long_as_their_weights(height):
    pixels, weights = drawn([1.0, 0.5, 0.25, 0.8], height), [0.5, 0.25, 0.8]
    full = length(pixels, COLOURS[0])
    assert full > height / 5
    for weight, colour in zip(weights, COLOURS[1:], strict=False):
        assert abs(length(pixels, colour) - weight * full) <= 1


def test_eight_bars_have_eight_colours():
    pixels = drawn([1.0] * 8)
    assert len(set(COLOURS)) >= 8
    areas = [len(where(pixels, colour)[0]) for colour in COLOURS[:8]]
    assert areas == pytest.approx([areas[0]] * 8, rel=0.05)  # a few pixels of the text are black, too


def test_bars_follow_one_another_from_above_and_start_together():
    pixels = drawn([0.3, 0.9, 0.6])
    rows, columns = zip(*(where(pixels, colour) for colour in COLOURS[:3]), strict=True)
    assert rows[0].max() < rows[1].min()
    assert rows[1].max() < rows[2].min()
    assert columns[0].min() == columns[1].min() == columns[2].min()


def test_a_bar_leaves_of_its_track_what_is_missing_to_1():
    rows, columns = where(drawn([1.0]), COLOURS[0])
    track = drawn([0.25])[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    bar, rest = len(where(track, COLOURS[0])[0]), len(where(track, FAINT)[0])
    assert bar + rest == track.shape[0] * track.shape[1]
    assert abs(bar / (bar + rest) - 0.25) < 0.02


def test_a_weight_of_0_has_no_bar_and_one_beyond_1_a_full_one():
    assert len(where(drawn([0.0]), COLOURS[0])[0]) == 0
    assert length(drawn([1.7]), COLOURS[0]) == length(drawn([1.0]), COLOURS[0])


def test_bars_stay_in_the_upper_left_corner():
    changed = np.nonzero((drawn([1.0] * 8) != 255).any(-1))
    assert changed[0].max() < 440 / 2
    assert changed[1].max() < 440 / 2


def test_eight_primitives_have_eight_colours():
    pixels = drawn([1.0] * 8)
    assert len(set(COLOURS)) == 8
    assert all(len(where(pixels, colour)[0]) > 0 for colour in COLOURS)
