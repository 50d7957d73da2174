"""A page as a folder of static files."""

import shutil
from collections.abc import Mapping
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase

from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.methods.transforms import TransformedCharacterEnv
from torchrl_mcp.runs.onnx_files import require_onnx
from torchrl_mcp.training.run_folder import replacing, write_json
from torchrl_mcp.viewer.page import description
from torchrl_mcp.viewer.page.networks import require_same_primitives, stages, write_stage
from torchrl_mcp.viewer.page.runtimes import NOTICES, runtimes
from torchrl_mcp.viewer.page.scene import for_browser, require_same_model

ABOUT = "page.json"
"""File that describes the policy to JavaScript; it is written last."""

Player = tuple[TensorDictModuleBase, CharacterEnv | TransformedCharacterEnv]
"""A policy and its environment."""


def write_page(players: Mapping[str, Player], folder: Path, *, title: str, command: str, half: bool = True) -> None:
    """Write a page on which a character follows one of several gates over the same primitives.

    Args:
        players: Policies by the names of their gates; the page begins with the first.
        folder: The folder to write; its other files remain.
        title: Title of the page.
        command: Command that makes the page.
        half: Store the networks in half precision.

    Raises:
        ValueError: If a task or character is unknown to the page, primitives differ, the browser's MuJoCo refuses a
            scene, or the runtimes cannot be fetched.
    """
    require_onnx(folder)
    envs = [description.require_playable(env) for _, env in players.values()]
    parts = [stages(policy) for policy, _ in players.values()]
    require_same_primitives(parts)
    libraries = runtimes()
    scenes = [for_browser(env.scene) for env in envs]
    for env, scene in zip(envs, scenes, strict=True):
        require_same_model(scene, env.simulation.model, libraries)
    _copy(libraries, folder)
    gates: list[dict[str, Any]] = []
    for index, (name, env) in enumerate(zip(players, envs, strict=True)):
        state = env.reset()[:1].select("observation", "goal")
        for part, stage in parts[index].items():
            if part == "gate" or index == 0:
                write_stage(
                    stage, state, folder / (f"gate-{index}.onnx" if part == "gate" else f"{part}.onnx"), half=half
                )
            stage.evaluate(state)
        with replacing(folder / f"scene-{index}.xml") as partial:
            partial.write_text(scenes[index], encoding="utf-8")
        files_ = {"scene": f"scene-{index}.xml", "network": f"gate-{index}.onnx"}
        gates.append({"name": name, **files_, **description.gate(env)})
    about = {"title": title, "command": command, **description.character(envs[0]), "gates": gates}
    write_json(about, folder / ABOUT)


def _copy(libraries: Path, folder: Path) -> None:
    """Copy page and runtimes to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with as_file(files(__package__) / "static") as page:
        shutil.copytree(page, folder, dirs_exist_ok=True)
    shutil.copytree(libraries, folder / "runtimes", dirs_exist_ok=True)
    (folder / "runtimes" / NOTICES).replace(folder / NOTICES)
