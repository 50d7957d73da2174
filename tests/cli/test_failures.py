"""What the command says when a run fails: a sentence with what is safe and how to go on."""

import pytest
from hydra.errors import InstantiationException
from omegaconf import OmegaConf

from torchrl_mcp.commands import train
from torchrl_mcp.runs import experiment


@pytest.fixture(params=["begun", "not begun"])
def cfg(request, tmp_path):
    if request.param == "begun":
        (tmp_path / "config.yaml").write_text("seed: 0")
    return OmegaConf.create({"resume": None, "run_dir": str(tmp_path)})


def said(cfg, monkeypatch, failure):
    def fail(cfg):
        raise failure

    monkeypatch.setattr(experiment, "train", fail)
    with pytest.raises(SystemExit) as stop:
        train.train(cfg)
    assert stop.value.code not in (0, 1)
    return str(stop.value.code)


@pytest.mark.parametrize(
    ("failure", "sentence"),
    [
        (OSError(28, "No space left on device"), "[Errno 28] No space left on device. "),
        (ChildProcessError("worker 0 of 2 has ended"), "worker 0 of 2 has ended. "),
        (KeyboardInterrupt(), "interrupted. "),
    ],
)
def test_what_comes_from_outside_ends_in_a_sentence_with_what_is_safe_and_how_to_go_on(
    cfg, monkeypatch, tmp_path, failure, sentence
):
    begun = (tmp_path / "config.yaml").exists()
    safe = f"go on with torchrl-mcp-train resume={tmp_path}" if begun else "No run has begun"
    text = said(cfg, monkeypatch, failure)
    assert text.strip().startswith(f"torchrl-mcp-train: {sentence}")
    assert safe in text


@pytest.mark.parametrize(
    ("failure", "sentence"),
    [
        (FloatingPointError("loss became nan"), "torchrl-mcp-train: loss became nan"),
        (InstantiationException("Error in call to target 'x':\nTypeError"), "Error in call to target 'x':; TypeError"),
    ],
)
def test_a_run_that_cannot_go_on_says_why(cfg, monkeypatch, failure, sentence):
    assert sentence in said(cfg, monkeypatch, failure)
