"""Composes the configuration of a run with Hydra, and completes it to the plan of the run."""

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.runs import places
from torchrl_mcp.runs.builtin import PREFIX, builtin, locate
from torchrl_mcp.training import checkpoint


@dataclass(frozen=True)
class Plan:
    """A run before anything is built or written.

    Attributes:
        cfg: The configuration, completed by the widths of the networks that the run loads.
        folder: The run folder.
        initial: Checkpoint file of the initial networks, or None for untrained networks.
        config: The configuration as it will be stored in the run folder, where the chosen precision replaces an
            ``autocast`` of ``auto``.
    """

    cfg: DictConfig
    folder: Path
    initial: Path | None
    config: dict[str, Any]


def compose_run(*overrides: str) -> DictConfig:
    """Return the configuration of ``torchrl-mcp-train`` with these arguments."""
    initialized = GlobalHydra.instance().is_initialized()  # true on the command line
    with nullcontext() if initialized else initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        return compose("train", list(overrides))


def planned(cfg: DictConfig) -> Plan:
    """Return the plan of a run, whose settings have been checked.

    Raises:
        ValueError: If the pre-training does not exist.
    """
    initial = initial_networks(cfg)
    folders = {name: cfg[name] for name in ("run_dir", "run_root")}
    cfg = cast("DictConfig", OmegaConf.merge(cfg, folders, _sizes(cfg, initial)))
    return Plan(cfg, Path(cfg.run_dir), initial, places.stored(cfg))


def initial_networks(cfg: DictConfig) -> Path | None:
    """Return the checkpoint file from which a run loads its initial networks, or None for untrained networks.

    Raises:
        ValueError: If the pre-training does not exist.
    """
    if cfg.pretrained is None or (cfg.stage.name == "transfer" and not cfg.transfer.keep):
        return None
    if cfg.pretrained == places.BUILTIN:
        return builtin(cfg.method.name, cfg.character.name)
    if cfg.pretrained.startswith(PREFIX):
        return locate(cfg.pretrained)
    return checkpoint.find(Path(cfg.pretrained))


def _sizes(cfg: DictConfig, initial: Path | None) -> dict[str, float]:
    """Return the widths of the networks that a run loads from a checkpoint file, and the gain of their noise."""
    if initial is None:
        return {}
    saved = checkpoint.saved_config(initial)
    width = saved.get("width", 1.0)  # older networks have the widths of the paper
    kept = {"kept_width": saved.get("kept_width", width), "std_gain": saved.get("std_gain", 1.0)}
    return kept if cfg.stage.name == "transfer" else {**kept, "width": width}
