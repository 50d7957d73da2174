"""What Ctrl-C and SIGTERM leave behind."""

import os
import signal

import pytest

from torchrl_mcp.commands import evaluate
from torchrl_mcp.training.workers import termination_as_interrupt


def test_an_interrupt_during_the_imports_of_a_command_is_no_traceback(monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "announce", interrupt)
    with pytest.raises(SystemExit, match="interrupted"):
        evaluate.main(["builtin:biped"])


def test_sigterm_is_an_interrupt_within_the_block_alone():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), termination_as_interrupt():
        os.kill(os.getpid(), signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before
