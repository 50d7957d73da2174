"""The notebook runs from top to bottom, with fewer steps and a shorter film."""

import json
import math
from pathlib import Path

import pytest

from torchrl_mcp.envs.rendering import opengl

NOTEBOOK = json.loads((Path(__file__).parents[1] / "docs" / "notebooks" / "first_steps.ipynb").read_text())
SMALLER = {"STEPS = 60_000": "STEPS = 4_000", "SECONDS = 6.0": "SECONDS = 0.2"}


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What the notebook's cells have defined."""
    names, folder = {}, tmp_path_factory.mktemp("notebook")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for number, cell in enumerate(NOTEBOOK["cells"]):
            if cell["cell_type"] == "code":
                code = "".join(cell["source"])
                for full, small in SMALLER.items():
                    code = code.replace(full, small)
                exec(compile(code, f"first_steps.ipynb, cell {number}", "exec"), names)
        names["film_size"] = Path("trex.gif").stat().st_size if Path("trex.gif").exists() else 0
    return names


def test_it_is_stored_without_outputs():
    assert all(not cell["outputs"] for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code")
    source = "".join("".join(cell["source"]) for cell in NOTEBOOK["cells"])
    assert all(full in source for full in SMALLER)


def test_stock_ppo_trains_the_composition(names):
    assert len(names["returns"]) == 2
    assert all(math.isfinite(value) for value in names["returns"])
    assert names["gates"].shape == (10, 200, 4)


def test_the_t_rex_follows_its_reference(names):
    assert names["trajectory"]["next", "tracking_error"].mean() < 0.3
    assert (names["film_size"] > 1000) == (opengl._platform() is not None)
