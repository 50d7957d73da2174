"""What training shows: on a terminal a bar of 80 columns, elsewhere a line every minute."""

import io
import re
import time

import pytest

from torchrl_mcp.training.progress import TrainingBar


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """The clock, in seconds, that a test sets."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def shown(terminal):
    return [line for line in terminal.getvalue().split("\r") if line.strip()]


def test_a_bar_has_eighty_columns_and_keeps_its_total_on_the_last_batch():
    terminal = Terminal()
    with TrainingBar(1_000_000, file=terminal) as bar:
        for _ in range(4):
            bar.advance(300_000, "return 0.500")
    assert max(len(line.strip("\n")) for line in shown(terminal)) <= 80
    assert "100%" in shown(terminal)[-1]
    assert "1.00M/1.00M" in shown(terminal)[-1]


def test_the_last_note_stays_until_there_is_another():
    terminal = Terminal()
    with TrainingBar(200, file=terminal) as bar:
        bar.advance(50)
        bar.advance(50, "return 0.250")
        bar.advance(100)
    assert "nan" not in terminal.getvalue()
    assert "return 0.250" in shown(terminal)[-1]


def test_a_resumed_run_begins_where_it_was():
    terminal = Terminal()
    with TrainingBar(1000, 750, file=terminal) as bar:
        bar.advance(0)
    assert " 75%" in shown(terminal)[0]


def test_without_a_terminal_there_is_a_plain_line_every_minute(clock):
    log = io.StringIO()
    with TrainingBar(1_000_000, 100_000, file=log) as bar:
        for clock[0] in (30, 59, 61, 100, 125):
            bar.advance(10_000, "return 0.500" if clock[0] < 60 else "")
    assert "\r" not in log.getvalue()
    estimate, *lines = log.getvalue().splitlines()
    assert estimate.startswith("about 43 min for 880,000 steps on this machine; ")  # 10,000 took 29 s
    assert [line.split(" steps")[0] for line in lines] == ["130,000 of 1,000,000", "150,000 of 1,000,000"]
    assert re.search(r"492 steps/s, 29 min left, return 0.500", lines[0])


def test_a_training_of_a_minute_needs_no_estimate_and_ends_at_its_total(clock):
    log = io.StringIO()
    with TrainingBar(100, file=log) as bar:
        for clock[0] in (1, 30, 61):
            bar.advance(40)
    assert log.getvalue().splitlines() == ["100 of 100 steps, 2 steps/s, 0 s left"]


def test_a_minute_without_a_step_is_a_line_that_says_so(clock):
    log = io.StringIO()
    with TrainingBar(1000, file=log) as bar:
        clock[0] = 61
        bar.advance(0)
    assert log.getvalue() == "0 of 1,000 steps, 0 steps/s\n"


def test_what_is_not_wanted_is_not_shown(clock):
    log = io.StringIO()
    with TrainingBar(100, shown=False, file=log) as bar:
        clock[0] = 100
        bar.advance(50, "return 0.500")
    assert log.getvalue() == ""
