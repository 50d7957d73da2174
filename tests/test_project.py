"""Files about the project: how to cite it, and what a host of repositories runs."""

import os
from pathlib import Path

import pytest
import yaml

from torchrl_mcp import __version__

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def test_the_citation_is_of_this_version_and_names_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__
    assert citation["preferred-citation"]["title"].startswith("MCP: Learning Composable Hierarchical Control")
    assert [author["family-names"] for author in citation["preferred-citation"]["authors"]] == [
        *("Peng", "Chang", "Zhang", "Abbeel", "Levine")
    ]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_may_read_and_nothing_else_and_calls_what_exists(path):
    workflow = yaml.safe_load(path.read_text())
    assert workflow["permissions"] == {"contents": "read"}
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    assert all("uses" in step or "run" in step for step in steps)
    for step in steps:
        for word in step.get("run", "").split():
            if word.startswith(".ci/"):
                assert os.access(ROOT / word, os.X_OK), word


def test_every_push_runs_what_continuous_integration_runs():
    (check,) = [path for path in WORKFLOWS if path.stem == "check"]
    assert "- run: .ci/run\n" in check.read_text()
