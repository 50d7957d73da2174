import pytest
import torch
from omegaconf import OmegaConf
from refusals import refused
from smoke import configure
from tensordict import TensorDict
from torch import nn
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.runs import build, builtin, configuration, experiment, policies, publish, records
from torchrl_mcp.training import checkpoint

BIPED = ["method=mcp", "character=biped", "task=imitation", "stage=pretrain"]


@pytest.fixture(autouse=True)
def _log_elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs divergence in the working directory


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A walker's first steps."""
    return experiment.train(
        configure(tmp_path_factory.mktemp("walker") / "run", *BIPED, "motions=single", "std_gain=0.5")
    )


@pytest.fixture(scope="module")
def published(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("published") / "mcp-biped.torchrl"
    policies.publish_run(run, path)
    return path


def act(path):
    """Actions of a checkpoint's policy in the same three states."""
    _, agent, _ = policies.restore(path, num_envs=1, seed=0)
    generator = torch.Generator().manual_seed(0)
    states = {key: torch.randn(3, size, generator=generator) for key, size in (("observation", 105), ("goal", 208))}
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return agent.actor.policy(TensorDict(states, [3]))["action"]


def test_a_published_policy_acts_as_the_run_does_up_to_the_precision_of_bfloat16(run, published):
    torch.testing.assert_close(act(published), act(run), atol=0.02, rtol=0)
    assert (act(published) != act(run)).any()


def test_a_folder_may_be_a_string(run):
    assert policies.evaluation(str(run), episodes=2, seed=0) == policies.evaluation(run, episodes=2, seed=0)
    assert experiment.resume(str(run)) == run


def test_primitives_of_another_mixer_are_named(run, tmp_path):
    additive = ["task=heading", "stage=transfer", "mixer=additive", "std_gain=0.5"]
    cfg = configure(tmp_path / "run", *BIPED[:2], *additive, f"pretrained={run}")
    env = build.make_env(cfg, num_envs=1, seed=0)
    with pytest.warns(UserWarning, match="pre-trained with mixer=multiplicative, and mixer=additive"):
        build.make_agent(cfg, env, checkpoint.find(run))


def test_the_values_that_choose_options_are_published_and_needed(tmp_path):
    run = experiment.train(configure(tmp_path / "run", "method=option_critic", *BIPED[1:], "training.total_frames=128"))
    policies.publish_run(run, tmp_path / "with.torchrl")
    _, agent, _ = policies.restore(tmp_path / "with.torchrl", num_envs=1, seed=0)
    cfg, original, _ = policies.restore(run, num_envs=1, seed=0)
    for name, parameter in original.parts["critic"].state_dict().items():
        assert torch.equal(agent.parts["critic"].state_dict()[name], parameter.bfloat16().float())
    del original.parts["critic"]
    publish.publish(original.parts, OmegaConf.to_container(cfg), tmp_path / "without.torchrl", shared={})
    refused(lambda: policies.restore(tmp_path / "without.torchrl", num_envs=1, seed=0), "critic")


def test_a_published_policy_is_a_small_part_of_the_checkpoint_and_names_no_folder(run, published):
    assert published.stat().st_size < checkpoint.find(run).stat().st_size / 8
    assert str(run.parent) not in str(checkpoint.saved_config(published))


def test_primitives_are_transferred_from_what_comes_with_the_library(run, published, tmp_path, monkeypatch):
    monkeypatch.setattr(builtin, "FOLDER", published.parent)
    transfer = ["method=mcp", "character=biped", "task=heading", "stage=transfer", "pretrained=builtin"]
    folder = experiment.train(configure(tmp_path / "run", *transfer, "training.total_frames=128"))
    _, agent, _ = policies.restore(folder, num_envs=1, seed=0)
    _, original, _ = policies.restore(run, num_envs=1, seed=0)
    for name, parameter in agent.parts["primitives"].state_dict().items():
        assert torch.equal(parameter, original.parts["primitives"].state_dict()[name].bfloat16().float())


def test_loaded_networks_keep_their_width_and_new_ones_have_the_runs(run, published, tmp_path):
    transfer = ["method=mcp", "character=biped", "task=heading", "stage=transfer", f"pretrained={published}"]
    folder = experiment.train(configure(tmp_path / "gate", *transfer, "width=0.125", "training.total_frames=128"))
    _, agent, _ = policies.restore(folder, num_envs=1, seed=0)
    _, original, _ = policies.restore(run, num_envs=1, seed=0)
    hidden = {name: first_layer(agent.parts[name]) for name in ("primitives", "gating")}
    assert hidden == {"primitives": first_layer(original.parts["primitives"]), "gating": 64}  # an eighth of 512
    longer = configure(tmp_path / "longer", *BIPED, "width=0.125", "training.total_frames=128", f"pretrained={run}")
    assert records.run_config(experiment.train(longer)).width == 0.0625


def test_loaded_networks_keep_the_scale_of_their_deviations(run, tmp_path):
    transfer = ["method=mcp", "character=biped", "task=heading", "stage=transfer", f"pretrained={run}"]
    folder = experiment.train(configure(tmp_path / "gate", *transfer, "training.total_frames=128"))
    _, agent, _ = policies.restore(folder, num_envs=1, seed=0)
    _, original, _ = policies.restore(run, num_envs=1, seed=0)
    states = torch.randn(10, original.parts["primitives"].trunk[0].in_features)
    torch.testing.assert_close(agent.parts["primitives"](states), original.parts["primitives"](states))
    assert records.run_config(folder).std_gain == records.run_config(run).std_gain == 0.5


def test_networks_of_earlier_versions_keep_theirs(tmp_path):
    transfer = ["method=mcp", "character=biped", "task=heading", "stage=transfer", "pretrained=builtin"]
    assert configuration.planned(configure(tmp_path / "run", *transfer, "std_gain=0.5")).cfg.std_gain == 1


@pytest.mark.parametrize(("preset", "gain"), [("fast", 0.1), ("comparison", 0.1), ("paper", 1)])
def test_the_ant_has_a_gain_except_in_the_paper(preset, gain):
    cfg = configuration.compose_run("method=mcp", "task=holdout", "stage=pretrain", f"preset={preset}")
    assert cfg.std_gain == gain


def test_pre_training_goes_on_from_another_with_other_motions(run, published, tmp_path):
    settings = [*BIPED, "motions=turning", "training.total_frames=128"]
    for origin, missing in ((checkpoint.find(run), set()), (published, {"critic"})):
        cfg = configure(tmp_path / "run", *settings, f"pretrained={origin}")
        env = build.make_env(cfg, num_envs=1, seed=0)
        assert len(env.library) == 7
        agent, other = build.make_agent(cfg, env, origin), policies.restore(origin, num_envs=1, seed=0)[1]
        for name in set(agent.parts) - missing:
            assert parameters(agent.parts[name]) == parameters(other.parts[name])
    folder = experiment.train(cfg)
    assert checkpoint.find(folder).is_file()


def first_layer(part):
    """Units of the first layer."""
    return next(layer.out_features for layer in part.modules() if isinstance(layer, nn.Linear))


def parameters(part):
    return {name: value.tolist() for name, value in part.state_dict().items()}


def test_what_does_not_come_with_the_library_is_named(published, tmp_path, monkeypatch):
    monkeypatch.setattr(builtin, "FOLDER", published.parent)
    cfg = configure(tmp_path / "run", "method=mcp", "character=trex", "task=heading", "stage=transfer")
    cfg.pretrained = "builtin"
    refused(lambda: experiment.train(cfg), "character=trex", "mcp-biped")


def test_a_command_line_names_a_path_or_what_comes_with_the_library(tmp_path):
    assert builtin.locate(str(tmp_path)) == tmp_path
    assert builtin.locate("builtin:biped") == builtin.FOLDER / "mcp-biped.torchrl"
    refused(lambda: builtin.locate("builtin:dog"), "builtin:dog", "builtin:biped")


@pytest.mark.trajectories
@pytest.mark.parametrize(
    "path",
    sorted(file for file in builtin.FOLDER.glob("*.torchrl") if not builtin.has_task(file)),
    ids=lambda path: path.stem,
)
def test_what_comes_with_the_library_follows_its_motions(path):
    results = policies.evaluation(path, episodes=16, seed=0, max_episode_steps=30)
    assert results["deterministic"]["terminated"] <= 0.25  # of 24 seeds 0.013 on average, 0.06 at most
    assert results["deterministic"]["metrics"]["tracking_error"] < 0.1  # 0.043 with a standard deviation of 0.006


@pytest.mark.parametrize("character", ["biped", "humanoid", "trex"])
def test_a_published_gate_is_restored_with_the_curriculum_of_its_training_and_evaluated_without(character):
    cfg, _, env = policies.restore(builtin.builtin("mcp", character, "heading"), num_envs=2, seed=0)
    assert cfg.evaluation.environment.curriculum is None
    assert env.curriculum.initial_states["motions"] > 0
    assert env.curriculum.random_first_length
    assert env.curriculum.reward_weights is None
