"""Suggestions for unknown settings on a command line."""

import difflib

from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf


def suggestions(arguments: list[str]) -> list[str]:
    """Return a line for each argument ``key=value`` with an unknown key, with the nearest known keys."""
    try:
        overrides = OverridesParser.create().parse_overrides([a for a in arguments if not a.startswith("-")])
        with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
            groups = list(compose("train", return_hydra_config=True).hydra.runtime.choices)
            # Methods and presets add settings.
            chosen = [str(o.input_line) for o in overrides if o.key_or_group in groups and not o.is_sweep_override()]
            cfg = compose("train", chosen, return_hydra_config=True)
    except HydraException:
        return []
    settings = _keys(OmegaConf.to_container(cfg))
    unknown = [o.key_or_group for o in overrides if o.key_or_group not in {*groups, *settings} and not o.is_add()]
    return [
        f"{key!r} is in no file, but is a valid argument: write it with a plus, +{key}=..."
        if _is_argument(key, cfg)
        else f"{key!r} is no setting of this method; the nearest are: "
        + ", ".join(difflib.get_close_matches(key, {*groups, *settings}, n=3, cutoff=0.5) or sorted(groups))
        for key in unknown
    ]


def _is_argument(key: str, cfg: DictConfig) -> bool:
    """Return whether a setting is an argument of its group's class or function."""
    group, _, name = key.rpartition(".")
    made = group and OmegaConf.select(cfg, f"{group}._target_")
    if not made:
        return False
    from torchrl_mcp.runs import build  # takes seconds

    return name in build.arguments(made)


def _keys(tree: object, prefix: str = "") -> list[str]:
    if not isinstance(tree, dict):
        return []
    return [name for key, value in tree.items() for name in (f"{prefix}{key}", *_keys(value, f"{prefix}{key}."))]
