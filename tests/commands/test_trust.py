"""The option ``--trust``, which stands between settings."""

import pytest
from refusals import refused

from torchrl_mcp.commands.parsing import take_trust


@pytest.mark.parametrize("words", [["--trust", "task=heading"], ["--trust"], ["--trust=a-b"]], ids=str)
def test_trust_without_the_name_of_a_module_is_refused(words):
    refused(lambda: take_trust(words), "--trust MODULE")


def test_trusted_modules_are_taken_from_the_settings_between_which_they_stand():
    assert take_trust(["seed=1", "--trust", "own.tasks", "task=run", "--trust=walker"]) == (
        ["own.tasks", "walker"],
        ["seed=1", "task=run"],
    )
