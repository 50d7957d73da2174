"""Writes a page as a folder of static files."""

import shutil
from collections.abc import Mapping
from importlib import resources
from pathlib import Path

from tensordict.nn import TensorDictModuleBase

from torchrl_mcp.envs import CharacterEnv, Imitation
from torchrl_mcp.methods.transforms import TransformedCharacterEnv
from torchrl_mcp.runs.onnx_files import require_onnx
from torchrl_mcp.training.run_folder import replacing, write_json
from torchrl_mcp.viewer.page import description
from torchrl_mcp.viewer.page.clips import write_clips
from torchrl_mcp.viewer.page.networks import require_same_primitives, stages, write_stage
from torchrl_mcp.viewer.page.runtimes import NOTICES, runtimes
from torchrl_mcp.viewer.page.scene import for_browser, require_same_model

ABOUT = "page.json"
"""File that describes the policy to JavaScript; it is written after all other files."""

Player = tuple[TensorDictModuleBase, CharacterEnv | TransformedCharacterEnv]
"""A policy and its environment."""


def write_page(players: Mapping[str, Player], folder: Path, *, title: str, command: str, half: bool = True) -> None:
    """Write a page on which a character follows one of several gates over the same primitives.

    Args:
        players: Policies by the names of their gates; the page begins with the first gate.
        folder: The folder to write; other files in the folder remain.
        title: Title of the page.
        command: Command that makes the page.
        half: Store the networks in half precision.

    Raises:
        ValueError: If the page cannot play a task or draw a character, the primitives differ, the browser's MuJoCo
            compiles a scene differently, or the runtimes cannot be fetched.
    """
    require_onnx(folder)
    envs = [description.require_playable(env) for _, env in players.values()]
    policies = [stages(policy) for policy, _ in players.values()]
    require_same_primitives(policies)
    libraries = runtimes()
    scenes = [for_browser(env.scene) for env in envs]
    for env, scene in zip(envs, scenes, strict=True):
        require_same_model(scene, env.simulation.model, libraries)
    _copy(libraries, folder)
    gates = []
    for index, (name, env, policy) in enumerate(zip(players, envs, policies, strict=True)):
        files = {"scene": f"scene-{index}.xml", "network": f"gate-{index}.onnx"}
        with replacing(folder / files["scene"]) as partial:
            partial.write_text(scenes[index], encoding="utf-8")
        names = {"primitives": "primitives.onnx", "gate": files["network"], "mixer": "mixer.onnx"}
        state = env.reset()[:1].select("observation", "goal")
        for part, stage in policy.items():
            if part == "gate" or index == 0:  # all gates share primitives and mixer
                write_stage(stage, state, folder / names[part], half=half)
            stage.evaluate(state)
        gate = {"name": name, **files, **description.gate(env)}
        clips = write_clips(env, folder, f"clip-{index}") if isinstance(env, Imitation) else [{}]
        gates += [{**gate, **clip} for clip in clips]
    about = {"title": title, "command": command, **description.character(envs[0]), "gates": gates}
    write_json(about, folder / ABOUT)


def _copy(libraries: Path, folder: Path) -> None:
    """Copy the page and the runtimes to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with resources.as_file(resources.files(__package__) / "static") as page:
        shutil.copytree(page, folder, dirs_exist_ok=True)
    shutil.copytree(libraries, folder / "runtimes", dirs_exist_ok=True)
    (folder / "runtimes" / NOTICES).replace(folder / NOTICES)
