import csv

import matplotlib
import numpy as np
import pytest
from matplotlib import _pylab_helpers
from matplotlib.colors import same_color, to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread
from refusals import refused

from torchrl_mcp.analysis import draw_curves, learning_curves, read_metrics, save_figure, write_curves
from torchrl_mcp.analysis.curves import plot_curves
from torchrl_mcp.analysis.figures import COLOURS

RETURN = "episode/normalised_return"


def write_run(folder, rows, columns=("iteration", "frames", "episode/count", RETURN)):
    folder.mkdir()
    with (folder / "metrics.csv").open("w", newline="") as file:
        csv.writer(file).writerows([columns, *((i, *row) for i, row in enumerate(rows, start=1))])
    return folder


def constant_run(folder, value, num_rows=10):
    return write_run(folder, [(100 * i, 1, value) for i in range(1, num_rows + 1)])


def test_a_bin_is_the_mean_over_its_episodes_not_over_its_rows(tmp_path):
    run = write_run(tmp_path / "run", [(100, 3, 1.0), (200, 1, 5.0), (300, 0, "nan"), (400, 2, 7.0)])
    (curve,) = learning_curves({"mcp": [run]}, num_bins=2)
    np.testing.assert_allclose(curve.mean, [(3 * 1.0 + 1 * 5.0) / 4, 7.0])


def test_a_quantity_that_is_no_mean_over_episodes_counts_every_row_alike(tmp_path):
    columns = ("iteration", "frames", "episode/count", "reward")
    run = write_run(tmp_path / "run", [(100, 3, 1.0), (200, 0, 5.0)], columns)
    (curve,) = learning_curves({"mcp": [run]}, quantity="reward", num_bins=1)
    np.testing.assert_allclose(curve.mean, [3.0])


@pytest.mark.parametrize("missing", ["nan", ""], ids=["nan", "blank"])
def test_bins_in_which_no_episode_ended_are_interpolated(tmp_path, missing):
    run = write_run(tmp_path / "run", [(100, 1, 2.0), (200, 0, missing), (300, 0, missing), (400, 1, 8.0)])
    (curve,) = learning_curves({"mcp": [run]}, num_bins=4)
    np.testing.assert_allclose(curve.mean, [2.0, 4.0, 6.0, 8.0])
    np.testing.assert_allclose(curve.frames, [50, 150, 250, 350])


def test_nothing_is_invented_before_the_first_episode(tmp_path):
    run = write_run(tmp_path / "run", [(100, 0, "nan"), (200, 0, "nan"), (300, 1, 1.0), (400, 1, 1.0)])
    (curve,) = learning_curves({"mcp": [run]}, num_bins=4)
    np.testing.assert_allclose(curve.frames, [250, 350])


def test_seeds_give_a_mean_and_a_range(tmp_path):
    runs = [constant_run(tmp_path / str(value), value) for value in (1.0, 2.0, 6.0)]
    (curve,) = learning_curves({"mcp": runs}, num_bins=5)
    assert curve.seeds == 3
    for values, expected in ((curve.mean, 3.0), (curve.low, 1.0), (curve.high, 6.0)):
        np.testing.assert_allclose(values, np.full(5, expected))


def test_a_curve_ends_with_its_shortest_seed_on_a_grid_common_to_all(tmp_path):
    short, long = constant_run(tmp_path / "short", 1.0, num_rows=5), constant_run(tmp_path / "long", 2.0)
    both, alone = learning_curves({"both": [short, long], "alone": [long]}, num_bins=10)
    np.testing.assert_allclose(both.frames, alone.frames[:5])
    np.testing.assert_allclose(both.mean, 1.5)


@pytest.mark.parametrize(("extra", "ends"), [(1, 250), (4, 250), (6, 350)])
def test_a_bin_of_which_a_run_covers_less_than_half_is_left_out(tmp_path, extra, ends):
    short = write_run(tmp_path / "short", [(10 * i, 1, 1.0) for i in range(1, 30 + extra + 1)])
    long = constant_run(tmp_path / "long", 2.0)
    curve, _ = learning_curves({"short": [short], "long": [long]}, num_bins=10)
    assert curve.frames[-1] == ends


@pytest.mark.parametrize("cut", [1, 2, 4, 12])
def test_a_row_half_written_is_left_out(tmp_path, cut):
    run = constant_run(tmp_path / "run", 1.0, num_rows=3)
    whole = (run / "metrics.csv").read_bytes().rstrip()
    (run / "metrics.csv").write_bytes(whole[: len(whole) - cut + 1])
    assert [row["frames"] for row in read_metrics(run)] == [100, 200]


def test_a_run_that_has_not_begun_has_no_rows(tmp_path):
    assert read_metrics(tmp_path) == []


def test_what_has_no_curve_is_refused(tmp_path):
    runs = {"mcp": [constant_run(tmp_path / "run", 1.0)]}
    refused(lambda: learning_curves(runs, quantity="speed"), "'speed'", "'frames'")
    refused(lambda: learning_curves(runs | {"scratch": []}), "'scratch'")
    unfinished = write_run(tmp_path / "unfinished", [(100, 0, "nan")])
    refused(lambda: learning_curves({"mcp": [unfinished]}), str(unfinished))
    refused(lambda: learning_curves({"mcp": [tmp_path / "elsewhere"]}), "elsewhere", "run folder")


def test_the_written_rows_hold_the_numbers_of_the_curves(tmp_path):
    runs = [constant_run(tmp_path / str(value), value) for value in (1.0, 2.0)]
    curves = learning_curves({"mcp": runs, "scratch": runs[:1]}, num_bins=3)
    write_curves(curves, tmp_path / "curves.csv")
    with (tmp_path / "curves.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["label"] for row in rows] == ["mcp"] * 3 + ["scratch"] * 3
    for name in ("frames", "mean", "low", "high"):
        np.testing.assert_array_equal(
            [float(row[name]) for row in rows], np.concatenate([getattr(curve, name) for curve in curves])
        )


def test_each_curve_is_one_line_of_its_own_colour_that_the_legend_names(tmp_path):
    run = constant_run(tmp_path / "run", 0.5)
    figure = draw_curves(learning_curves({name: [run] for name in "abcdefgh"}, num_bins=4))
    lines = figure.axes[0].lines
    assert [text.get_text() for text in figure.legends[0].get_texts()] == list("abcdefgh")
    assert len(lines) == 8
    assert not any(same_color(a.get_color(), b.get_color()) for a in lines[:7] for b in lines[:7] if a is not b)
    for line in lines:
        np.testing.assert_allclose(line.get_ydata(), 0.5)


def test_no_curve_is_left_out_however_many_there_are(tmp_path):
    run = constant_run(tmp_path / "run", 0.5)
    figure = draw_curves(learning_curves({str(number): [run] for number in range(30)}, num_bins=4))
    assert len(figure.axes[0].lines) == len(figure.legends[0].get_texts()) == 30


def test_a_curve_of_a_single_point_is_seen(tmp_path):
    runs = [constant_run(tmp_path / f"{number} rows", 0.5, num_rows=number) for number in (1, 10)]
    single, line = learning_curves({run.name: [run] for run in runs}, num_bins=10)
    assert (len(single.frames), len(line.frames)) == (1, 10)
    picture, _ = save_figure(draw_curves([single]), tmp_path / "dot")
    below_the_legend = imread(picture)[60:, :, :3]
    assert np.isclose(below_the_legend, to_rgb(COLOURS[0]), atol=0.01).all(-1).sum() > 100
    assert [line.get_marker() for line in draw_curves([line]).axes[0].lines] == ["None"]


def test_the_legend_names_curves_that_begin_with_an_underscore(tmp_path):
    run = constant_run(tmp_path / "run", 0.5)
    figure = draw_curves(learning_curves({name: [run] for name in ("_baseline", "tuned")}))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["_baseline", "tuned"]


@pytest.mark.parametrize("length", [1, 26, 28, 60])
def test_the_legend_lies_within_the_figure_and_leaves_the_axes_their_height(tmp_path, length):
    run = constant_run(tmp_path / "run", 0.5)
    figure = draw_curves(learning_curves({letter * length: [run] * 2 for letter in "abcdefghijk"}, num_bins=4))
    figure.draw_without_rendering()
    legend, axes = figure.legends[0].get_window_extent(), figure.axes[0].get_window_extent()
    assert 0 <= legend.x0 < legend.x1 <= figure.bbox.width
    assert axes.y1 <= legend.y0 < legend.y1 <= figure.bbox.height
    assert axes.height > 1.8 * figure.dpi


def test_lines_can_have_styles_of_their_own_and_need_no_legend(tmp_path):
    curves = learning_curves({name: [constant_run(tmp_path / name, 0.5)] for name in "ab"})
    axes = Figure().add_subplot()
    plot_curves(axes, curves, [{"color": "red", "linestyle": "--"}, {"color": "blue", "linewidth": 3}])
    first, second = axes.lines
    assert (first.get_color(), first.get_linestyle(), second.get_linewidth()) == ("red", "--", 3)
    assert axes.get_legend() is None


def test_seeds_that_never_ran_at_the_same_time_have_no_curve_but_can_be_drawn(tmp_path):
    early = write_run(tmp_path / "early", [(100, 1, 0.5)])
    late = write_run(tmp_path / "late", [(1000, 1, -0.5)])
    curves = learning_curves({"both": [early, late], "late": [late]}, num_bins=10)
    assert [len(curve.frames) for curve in curves] == [0, 1]
    low, high = draw_curves(curves).axes[0].get_ylim()
    assert low <= -0.5
    assert high >= 0


def test_saved_figures_show_something_and_are_the_same_bytes_again(tmp_path):
    curves = learning_curves({"mcp": [constant_run(tmp_path / "run", 0.5)]})
    first = save_figure(draw_curves(curves), tmp_path / "a" / "curves")
    second = save_figure(draw_curves(curves), tmp_path / "b" / "curves")
    assert [path.name for path in first] == ["curves.png", "curves.svg"]
    assert imread(first[0]).std() > 0.01
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()


def test_drawing_leaves_matplotlibs_global_state_alone(tmp_path):
    before = dict(matplotlib.rcParams)
    save_figure(draw_curves(learning_curves({"mcp": [constant_run(tmp_path / "run", 0.5)]})), tmp_path / "curves")
    assert dict(matplotlib.rcParams) == before
    assert not _pylab_helpers.Gcf.figs
