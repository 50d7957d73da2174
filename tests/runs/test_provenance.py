import json
import shutil
import subprocess
import sys
from datetime import UTC, datetime

import pytest
import torch
from omegaconf import OmegaConf

from torchrl_mcp import __version__
from torchrl_mcp.runs import provenance
from torchrl_mcp.training.precision import Precision


def git(folder, *arguments):
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    return subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def checkout(tmp_path):
    if shutil.which("git") is None:
        pytest.skip("needs git")
    package = tmp_path / "package"
    package.mkdir()
    (package / "code.py").write_text("1\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "package/code.py")
    git(tmp_path, "commit", "-q", "-m", "one")
    return tmp_path


def test_the_commit_is_that_of_the_checkout_and_says_whether_files_were_changed_since(checkout):
    head = git(checkout, "rev-parse", "HEAD").strip()
    commit = provenance.commit(checkout / "package")
    assert len(commit) >= 7
    assert head.startswith(commit)
    (checkout / "package" / "code.py").write_text("2\n")
    assert provenance.commit(checkout / "package") == f"{commit}-dirty"


def test_a_changed_result_does_not_make_the_commit_dirty_but_changed_code_does(checkout):
    results = checkout / "results"
    results.mkdir()
    (results / "table.csv").write_text("1\n")
    git(checkout, "add", "results")
    git(checkout, "commit", "-q", "-m", "two")
    (results / "table.csv").write_text("2\n")
    commit = provenance.commit(checkout / "package", results=results)
    assert git(checkout, "rev-parse", "HEAD").startswith(commit)
    assert provenance.commit(checkout / "package") == f"{commit}-dirty"
    (checkout / "package" / "code.py").write_text("2\n")
    assert provenance.commit(checkout / "package", results=results) == f"{commit}-dirty"


def test_what_lies_in_a_checkout_untracked_or_in_none_has_no_commit(checkout, tmp_path_factory):
    installed = checkout / ".venv" / "package"
    installed.mkdir(parents=True)
    (installed / "code.py").touch()
    assert provenance.commit(installed) is None
    assert provenance.commit(tmp_path_factory.mktemp("elsewhere")) is None


def test_provenance_names_command_code_time_and_machine(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["script.py", "seed=3"])
    monkeypatch.setattr(provenance.HydraConfig, "initialized", lambda: False)
    precision, inputs = Precision(True, "as measured"), {"pretrained": "1234abcd"}
    where_from = provenance.provenance("cpu", precision, inputs)
    content = json.loads(json.dumps(where_from))
    assert content["command"] == ["script.py", "seed=3"]
    assert content["precision"] == "networks in bfloat16: as measured"
    assert content["inputs"] == inputs
    assert content["version"] == __version__
    assert abs((datetime.now(UTC) - datetime.fromisoformat(content["started"])).total_seconds()) < 60
    assert content["machine"]["torch"] == torch.__version__
    assert content["machine"]["device"] == "cpu"
    assert content["machine"]["cores"] >= 1
    assert content["machine"]["processor"]


def test_within_hydra_command_and_choices_are_those_of_the_job(monkeypatch):
    hydra = OmegaConf.create(
        {
            "overrides": {"task": ["preset=fast", "seed=1"]},
            "runtime": {"choices": {"preset": "fast", "hydra/launcher": "basic", "benchmark": None}},
        }
    )
    monkeypatch.setattr(provenance.HydraConfig, "initialized", lambda: True)
    monkeypatch.setattr(provenance.HydraConfig, "get", lambda: hydra)
    assert provenance.launched() == (["torchrl-mcp-train", "preset=fast", "seed=1"], {"preset": "fast"})
