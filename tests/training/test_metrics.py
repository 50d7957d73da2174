import csv
import math

import pytest
from refusals import refused
from torchrl.record.loggers import get_logger

from torchrl_mcp.training.metrics import MetricsWriter
from torchrl_mcp.training.run_folder import read_metrics


class Recorder:
    """Stands in for a TorchRL logger."""

    def __init__(self):
        self.calls = []

    def log_metrics(self, metrics, step=None):
        self.calls.append((metrics, step))


def table(folder):
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def fill(folder, iterations):
    writer = MetricsWriter(folder)
    for i in iterations:
        writer.write({"iteration": i, "frames": 100 * i, "loss": i / 3}, step=100 * i)
    return writer


def test_every_row_has_the_columns_of_all_others(tmp_path):
    writer = MetricsWriter(tmp_path)
    writer.write({"iteration": 1, "loss": 0.1}, step=100)
    writer.write({"loss": math.nan, "iteration": 2}, step=200)
    assert (tmp_path / "metrics.csv").read_text().splitlines() == ["iteration,loss", "1,0.1", "2,nan"]
    writer.write({"iteration": 3, "new": 1.0}, step=300)
    writer.write({"iteration": 4, "loss": 0.2, "new": 2.0}, step=400)
    lines = ["iteration,loss,new", "1,0.1,nan", "2,nan,nan", "3,nan,1.0", "4,0.2,2.0"]
    assert (tmp_path / "metrics.csv").read_text().splitlines() == lines


def test_a_run_goes_on_with_other_metrics_than_those_of_an_earlier_version(tmp_path):
    fill(tmp_path, [1, 2])
    writer = MetricsWriter(tmp_path)
    writer.rewind(1)
    writer.write({"iteration": 2, "frames": 200, "new": 0.5}, step=200)
    first, second = read_metrics(tmp_path)
    assert (first["loss"], second["new"]) == (1 / 3, 0.5)
    assert math.isnan(first["new"])
    assert math.isnan(second["loss"])


def test_a_kill_while_columns_are_added_loses_no_row(tmp_path, monkeypatch):
    writer = fill(tmp_path, [1, 2])
    before = (tmp_path / "metrics.csv").read_bytes()

    def killed(self, rows):
        raise KeyboardInterrupt

    monkeypatch.setattr("csv.DictWriter.writerows", killed)
    with pytest.raises(KeyboardInterrupt):
        writer.write({"iteration": 3, "new": 1.0}, step=300)
    assert (tmp_path / "metrics.csv").read_bytes() == before


@pytest.mark.parametrize("held", ["", "iteration,frames,loss\n"], ids=["nothing", "header"])
def test_a_file_without_rows_gets_one_header(tmp_path, held):
    (tmp_path / "metrics.csv").write_text(held)
    fill(tmp_path, [1])
    assert (tmp_path / "metrics.csv").read_text().splitlines() == ["iteration,frames,loss", f"1,100,{1 / 3}"]


def test_numbers_survive_the_file_to_the_bit(tmp_path):
    numbers = {"iteration": 1, "third": 1 / 3, "tiny": 5e-324, "large": 1.7976931348623157e308, "infinite": math.inf}
    MetricsWriter(tmp_path).write(numbers, step=1)
    assert {name: float(value) for name, value in table(tmp_path)[0].items()} == numbers


def test_loggers_get_every_metric_that_is_a_number(tmp_path):
    loggers = [Recorder(), Recorder()]
    writer = MetricsWriter(tmp_path, loggers)
    writer.write({"iteration": 1, "return": math.nan, "loss": 0.1}, step=100)
    writer.write({"iteration": 2, "return": 7.0, "loss": math.inf}, step=200)
    for logger in loggers:
        assert logger.calls == [
            ({"iteration": 1, "loss": 0.1}, 100),
            ({"iteration": 2, "return": 7.0, "loss": math.inf}, 200),
        ]


def test_rewinding_drops_what_came_after_the_checkpoint(tmp_path):
    fill(tmp_path, range(1, 13))
    before = table(tmp_path)
    writer = MetricsWriter(tmp_path)
    writer.rewind(10)
    assert table(tmp_path) == before[:10]
    writer.write({"iteration": 11, "frames": 1, "loss": 2.0}, step=1)
    assert table(tmp_path) == [*before[:10], {"iteration": "11", "frames": "1", "loss": "2.0"}]


def test_wherever_a_kill_cuts_the_file_a_continued_run_writes_a_whole_one(tmp_path):
    fill(tmp_path, [8, 9, 10, 11])
    file = tmp_path / "metrics.csv"
    whole, expected = file.read_bytes(), table(tmp_path)
    safe = whole.index(b"10,1000")  # the checkpoint of iteration 9 is younger than its row
    for cut in range(safe, len(whole)):
        file.write_bytes(whole[:cut])
        writer = MetricsWriter(tmp_path)
        writer.rewind(9)
        assert table(tmp_path) == expected[:2], cut
        for i in (10, 11):
            writer.write({"iteration": i, "frames": 100 * i, "loss": i / 3}, step=100 * i)
        assert table(tmp_path) == expected, cut
        assert file.read_bytes() == whole, cut


def test_a_kill_while_rewinding_loses_no_row(tmp_path, monkeypatch):
    fill(tmp_path, range(1, 13))
    before = table(tmp_path)

    def killed(self, rows):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("csv.DictWriter.writerows", killed)
        with pytest.raises(KeyboardInterrupt):
            MetricsWriter(tmp_path).rewind(10)
    assert table(tmp_path) == before
    MetricsWriter(tmp_path).rewind(10)
    assert table(tmp_path) == before[:10]
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.csv"]


def test_a_header_that_a_kill_cut_short_is_written_anew(tmp_path):
    fill(tmp_path, [1, 2])
    file = tmp_path / "metrics.csv"
    whole = file.read_bytes()
    for cut in range(whole.index(b"1,100")):
        file.write_bytes(whole[:cut])
        writer = MetricsWriter(tmp_path)
        writer.rewind(0)
        for i in (1, 2):
            writer.write({"iteration": i, "frames": 100 * i, "loss": i / 3}, step=100 * i)
        assert file.read_bytes() == whole, cut


def test_rewinding_before_anything_was_written_does_nothing(tmp_path):
    writer = MetricsWriter(tmp_path)
    writer.rewind(0)
    assert not (tmp_path / "metrics.csv").exists()
    writer.write({"iteration": 1}, step=1)
    assert table(tmp_path) == [{"iteration": "1"}]


def test_rows_that_are_missing_before_a_checkpoint_are_named_and_the_file_stays(tmp_path):
    fill(tmp_path, range(1, 8))
    refused(lambda: MetricsWriter(tmp_path).rewind(10), "metrics.csv", "7", "10", untouched=tmp_path)
    refused(lambda: MetricsWriter(tmp_path / "gone").rewind(10), "metrics.csv", "0", untouched=tmp_path)


def test_a_file_that_somebody_removes_is_missed_at_the_next_row_and_the_next_checkpoint(tmp_path):
    writer = fill(tmp_path, [1])
    (tmp_path / "metrics.csv").unlink()
    row = {"iteration": 2, "frames": 200, "loss": 0.1}
    refused(lambda: writer.write(row, step=200), "metrics.csv", error=FileNotFoundError, untouched=tmp_path)
    refused(writer.flush, "metrics.csv", error=FileNotFoundError, untouched=tmp_path)


def test_the_csv_logger_holds_every_step_once_after_a_rewind(tmp_path):
    def writer():
        logger = get_logger("csv", logger_name=str(tmp_path), experiment_name="csv")
        return MetricsWriter(tmp_path, [logger])

    first = writer()
    for i in range(1, 6):
        first.write({"iteration": i, "frames": 100 * i, "task/loss": i / 2}, step=100 * i)
    with (tmp_path / "csv/scalars/task/loss.csv").open("a") as file:
        file.write("6")  # of 600: the disk was full
    second = writer()
    second.rewind(3)
    for i in (4, 5):
        second.write({"iteration": i, "frames": 100 * i, "task/loss": i / 2}, step=100 * i)
    lines = (tmp_path / "csv/scalars/task/loss.csv").read_text().split()
    assert lines == ["100,0.5", "200,1.0", "300,1.5", "400,2.0", "500,2.5"]


def test_a_row_with_a_number_too_many_or_none_is_dropped_where_a_run_goes_on_and_named_where_it_is_read(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("iteration,frames,loss\n1,10,0,5\n2,20,0.5\n")
    refused(lambda: read_metrics(tmp_path), "metrics.csv:2")
    MetricsWriter(tmp_path).rewind(2)
    assert table(tmp_path) == [{"iteration": "2", "frames": "20", "loss": "0.5"}]
