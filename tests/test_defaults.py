"""A default stands once: in code, or in a file of the configuration."""

import inspect
from collections import defaultdict
from pathlib import Path

import yaml
from hydra.utils import get_object

from torchrl_mcp import conf

CONF = Path(conf.__file__).parent
TRAINED_SHORTER = {"max_episode_steps"}
"""What all files set to another value than the default: episodes of training are shorter than those of the task."""


def made(tree):
    """Whatever a file makes: its name and the arguments that the file sets."""
    if isinstance(tree, dict):
        if str(tree.get("_target_")).startswith("torchrl_mcp."):
            yield tree["_target_"], {key: value for key, value in tree.items() if not key.startswith("_")}
        for branch in tree.values():
            yield from made(branch)
    elif isinstance(tree, list):
        for branch in tree:
            yield from made(branch)


def own_defaults(name):
    """Arguments with a default in our code, those included that a class passes on to one of ours."""
    thing = get_object(name)
    found = {}
    for kind in thing.__mro__ if inspect.isclass(thing) else [thing]:
        maker = vars(kind).get("__init__") if inspect.isclass(kind) else kind
        if not inspect.isfunction(maker) or not maker.__module__.startswith("torchrl_mcp."):
            continue
        parameters = inspect.signature(maker).parameters.values()
        found = {p.name: p.default for p in parameters if p.default is not p.empty} | found
    return found


def plain(value):
    return [plain(item) for item in value] if isinstance(value, (list, tuple)) else value


USES = [
    (path.relative_to(CONF), name, arguments)
    for path in sorted(CONF.rglob("*.yaml"))
    for name, arguments in made(yaml.safe_load(path.read_text()))
]


def test_no_file_repeats_the_default_of_an_argument():
    assert len(USES) > 30
    for path, name, arguments in USES:
        defaults = own_defaults(name)
        for key in arguments.keys() & defaults.keys():
            assert plain(arguments[key]) != plain(defaults[key]), (
                f"{path} sets {key} of {name} to its default: leave the line out, or the default of the argument"
            )


def test_no_default_is_replaced_by_one_other_value_wherever_it_could_hold():
    values = defaultdict(set)
    for _, name, arguments in USES:
        for key in own_defaults(name):
            values[name, key].add(repr(arguments.get(key, "default")))
    for (name, key), found in values.items():
        only = found.pop() if len(found) == 1 else "'default'"
        assert only == "'default'" or "${" in only or key in TRAINED_SHORTER, f"{key} of {name} is always {only}"
