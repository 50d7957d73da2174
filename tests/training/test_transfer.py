import pytest
import torch
from refusals import refused
from torch import nn

from torchrl_mcp.modules import Gating, JointGating, RunningNormaliser
from torchrl_mcp.training.transfer import FrozenParts, fingerprint, require_frozen_input, require_parts, widen_goal


def make():
    torch.manual_seed(0)
    return nn.ModuleDict(
        {"primitives": nn.Linear(2, 1), "gating": nn.Linear(3, 1), "observation_normaliser": RunningNormaliser(2)}
    )


def bits(tensor):
    """The memory of ``tensor`` as integers."""
    return tensor.data.view({4: torch.int32, 8: torch.int64}[tensor.element_size()]).view(-1)


def flip(tensor, bit, index=0):
    bits(tensor)[index] ^= torch.tensor(1, dtype=bits(tensor).dtype) << bit


def test_frozen_parts_require_no_gradient_and_the_others_still_do():
    parts = make()
    frozen = FrozenParts(parts, ["primitives"])
    assert not any(parameter.requires_grad for parameter in parts["primitives"].parameters())
    assert all(parameter.requires_grad for parameter in parts["gating"].parameters())
    assert "primitives" in frozen
    assert "gating" not in frozen


def test_untouched_parts_pass_while_the_others_train():
    parts = make()
    frozen = FrozenParts(parts, ["primitives", "observation_normaliser"])
    with torch.no_grad():
        parts["gating"].weight += 1
    parts["observation_normaliser"](torch.randn(5, 2))
    frozen.verify()


@pytest.mark.parametrize("bit", [0, 13, 31])
@pytest.mark.parametrize(
    ("part", "tensor"),
    [
        ("primitives", "weight"),
        ("primitives", "bias"),
        ("observation_normaliser", "mean"),
        ("observation_normaliser", "variance"),
        ("observation_normaliser", "count"),
    ],
)
def test_one_changed_bit_of_a_parameter_or_buffer_is_noticed(part, tensor, bit):
    parts = make()
    frozen = FrozenParts(parts, ["primitives", "observation_normaliser"])
    target = parts[part].state_dict()[tensor]
    flip(target, bit)
    with pytest.raises(RuntimeError, match=part):
        frozen.verify()
    flip(target, bit)
    frozen.verify()


def test_a_normaliser_that_keeps_learning_is_noticed():
    parts = make()
    frozen = FrozenParts(parts, ["observation_normaliser"])
    parts["observation_normaliser"].update(torch.randn(5, 2))
    with pytest.raises(RuntimeError, match="observation_normaliser"):
        frozen.verify()


def test_its_state_holds_a_continued_run_to_the_parts_it_began_with():
    parts = make()
    state = FrozenParts(parts, ["primitives"]).state_dict()
    with torch.no_grad():
        parts["primitives"].weight += 1
    continued = FrozenParts(parts, ["primitives"])
    continued.verify()
    continued.load_state_dict(state)
    with pytest.raises(RuntimeError, match="primitives"):
        continued.verify()


def test_freezing_nothing_is_allowed():
    parts = make()
    FrozenParts(parts, []).verify()
    assert all(parameter.requires_grad for parameter in parts.parameters())


def test_an_unknown_part_is_refused_and_the_known_ones_are_named():
    refused(lambda: FrozenParts(make(), ["primitive", "gating"]), "transfer.freeze", "'primitive'", "'primitives'")
    keep = ["primitive", "gating", "critic"]
    refused(lambda: require_parts(make(), keep, "transfer.keep"), "transfer.keep", "['critic', 'primitive']")
    require_parts(make(), ["gating", "primitives"], "transfer.keep")


def test_the_fingerprint_depends_on_every_bit():
    module = nn.Sequential(nn.Linear(2, 1), RunningNormaliser(1))
    seen = {fingerprint(module)}
    num_bits = 0
    for tensor in module.state_dict().values():
        for index in range(tensor.numel()):
            for bit in range(8 * tensor.element_size()):
                flip(tensor, bit, index)
                seen.add(fingerprint(module))
                flip(tensor, bit, index)
                num_bits += 1
    # Three numbers of the layer, mean and variance of 32 bits each; the count has 64.
    assert num_bits == 5 * 32 + 64
    assert len(seen) == num_bits + 1


def test_the_fingerprint_depends_on_names_and_on_nothing_else():
    torch.manual_seed(0)
    layer = nn.Linear(2, 2)
    assert fingerprint(nn.ModuleDict({"a": layer})) != fingerprint(nn.ModuleDict({"b": layer}))
    twin = nn.Linear(2, 2)
    assert fingerprint(layer) != fingerprint(twin)
    twin.load_state_dict(layer.state_dict())
    assert fingerprint(layer) == fingerprint(twin)
    assert fingerprint(layer) == fingerprint(twin.requires_grad_(False).eval())


NETWORKS = ["primitives", "observation_normaliser"]


@pytest.mark.parametrize(
    ("keep", "freeze", "names"),
    [
        (NETWORKS, ["primitives"], ["transfer.freeze", "observation_normaliser"]),
        (["primitives"], NETWORKS, ["transfer.keep", "observation_normaliser"]),
        (NETWORKS, [*NETWORKS, "critic"], ["transfer.freeze", "critic"]),
    ],
    ids=["normaliser not frozen", "normaliser not kept", "critic frozen"],
)
def test_frozen_networks_whose_inputs_would_change_are_refused(keep, freeze, names):
    refused(lambda: require_frozen_input(make(), keep, freeze), *names)


@pytest.mark.parametrize(
    ("keep", "freeze"), [(NETWORKS, NETWORKS), (NETWORKS, NETWORKS[1:]), (NETWORKS, []), ([], []), ([], NETWORKS)]
)
def test_networks_are_frozen_with_their_normaliser_or_not_at_all(keep, freeze):
    require_frozen_input(make(), keep, freeze)


@pytest.mark.parametrize("kind", [Gating, JointGating])
def test_a_gate_whose_goal_becomes_an_entry_of_another_ignores_the_other_entries(kind):
    torch.manual_seed(0)
    narrow, wide = kind(5, 2, 4, width=0.05), kind(5, 7, 4, width=0.05)
    widen_goal(wide, narrow, slice(3, 5))
    state, goal = torch.randn(20, 5), torch.randn(20, 7)
    torch.testing.assert_close(wide(state, goal), narrow(state, goal[:, 3:5]))


def test_the_others_can_be_learned():
    narrow, wide = Gating(5, 2, 4, width=0.05), Gating(5, 7, 4, width=0.05)
    widen_goal(wide, narrow, slice(3, 5))
    wide(torch.randn(20, 5), torch.randn(20, 7)).square().sum().backward()
    assert (wide.goal_encoder[0].weight.grad.norm(dim=0) > 0).all()


def test_a_normaliser_keeps_the_entry_and_leaves_the_others_as_they_are():
    narrow, wide = RunningNormaliser(2), RunningNormaliser(4)
    narrow.update(torch.tensor([[0.0, 10.0], [2.0, 30.0]]))
    widen_goal(wide, narrow, slice(1, 3))
    torch.testing.assert_close(wide(torch.tensor([3.0, 1.0, 30.0, 4.0])), torch.tensor([3.0, 0.0, 1.0, 4.0]))


def test_a_normaliser_learns_the_others_from_the_first_samples_and_goes_on_with_the_entry():
    generator = torch.Generator().manual_seed(0)
    before, after = torch.randn(3000, 1, generator=generator), 5 + 2 * torch.randn(1000, 2, generator=generator)
    narrow, wide = RunningNormaliser(1), RunningNormaliser(2)
    narrow.update(before)
    widen_goal(wide, narrow, slice(1, 2))
    wide.update(after)
    both = torch.cat([before, after[:, 1:]])
    torch.testing.assert_close(wide.mean, torch.cat([after[:, :1].mean(0), both.mean(0)]))
    torch.testing.assert_close(wide.variance, torch.cat([after[:, :1].var(0), both.var(0)]), rtol=2e-3, atol=0)
    restored = RunningNormaliser(2)
    restored.load_state_dict(wide.state_dict())
    for normaliser in (wide, restored):
        normaliser.update(after + 1)
    torch.testing.assert_close(restored.state_dict(), wide.state_dict(), rtol=0, atol=0)
    torch.testing.assert_close(wide.mean[0], after[:, 0].mean() + 0.5)
