from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from torchrl_mcp.runs import configuration
from torchrl_mcp.runs.settings import leaves, replaced

KEYS = st.text("abc", min_size=1, max_size=3)
VALUES = st.none() | st.integers() | st.text("xy") | st.lists(st.integers(), max_size=2)
CONFIGS = st.recursive(VALUES, lambda inner: st.dictionaries(KEYS, inner, max_size=3) | st.lists(inner, max_size=3))


@given(st.dictionaries(KEYS, CONFIGS))
def test_every_leaf_is_what_omegaconf_selects_by_its_name(config):
    cfg = OmegaConf.create(config)
    for name, value in leaves(config):
        assert OmegaConf.to_container(OmegaConf.create([OmegaConf.select(cfg, name)]))[0] == value


@given(st.dictionaries(KEYS, CONFIGS))
def test_a_replaced_leaf_has_its_new_value_and_all_others_stay(config):
    names = [name for name, _ in leaves(config)]
    assert replaced(config, {}) == config
    for name in names:
        changed = dict(leaves(replaced(config, {name: "new"})))
        assert changed == {**dict(leaves(config)), name: "new"}


def test_a_list_of_groups_is_a_group_and_a_list_of_numbers_is_a_value():
    cfg = configuration.compose_run("task=carry", "stage=transfer", "curriculum=mixed", "run_dir=never")
    settings = dict(leaves(OmegaConf.to_container(cfg, resolve=True)))
    mixture = cfg.task.transfer.curriculum.mixture
    assert settings["task.transfer.curriculum.mixture.2.weight"] == mixture[2].weight
    assert settings["method.standard.num_primitives"] == 8
