"""Plausible faults, each of which the tests must catch: ``make test-faults``.

    python tests/support/faults.py [WORD ...]

A fault is a slip of a few letters in the library: a sign, an index, a missing detach, a dropped check. The command puts
one fault at a time into a copy of the files, and runs the tests that are named beside the fault. It ends with 1 if
these tests pass, or the one that fails does so without the fault, too, or if a text to replace is not in its file
exactly once. With words, it tries the faults whose file, texts or tests contain one of them. All faults take half an
hour.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

for module in ("tensordict", "torchrl.envs", "torchrl.objectives", "mujoco", "hydra", "hypothesis", "scipy.stats"):
    import_module(module)

ROOT = Path(__file__).resolve().parents[2]

VALUE = "runs/test_validation.py::test_a_value_that_a_setting_cannot_have_is_named"
ARGUMENT = "envs/tasks/test_arguments.py"
GROUP = "runs/test_validation.py::test_a_group_in_place_of_a_value_is_named"
GIVEN = "runs/test_validation.py::test_a_wrong_value_of_an_argument_that_replaces_one_of_the_task_is_named"
INHERITED = (
    "runs/test_validation.py::test_the_arguments_of_a_user_s_task_have_the_rules_of_its_signature_and_of_its_bases"
)
PLACE = "runs/test_validation.py::test_no_setting_takes_a_run_out_of_the_folder_of_runs"
KEY = "runs/test_keys.py::test_a_setting_that_is_misspelt_or_in_a_wrong_group_is_named"
BODY = "runs/test_faults.py::test_a_run_does_not_go_on_with_another_body"
BITS = "training/test_trainer.py::test_a_run_continues_in_or_after_its_warm_up_to_the_same_numbers_bit_for_bit"
FIRST = "runs/test_faults.py::test_a_run_killed_before_its_first_step_keeps_the_networks_with_which_it_began"
NETWORKS = "runs/test_places.py::test_folders_of_other_networks_have_other_names_wherever_those_are"
LONGER = "runs/test_places.py::test_a_longer_run_goes_on_from_another_folder_after_a_move_as_one_that_was_planned"

FAULTS = {
    # Environments of other libraries
    "torchrl_mcp/adapters/adapter.py": [
        (
            "self._elapsed >= self.max_episode_steps",
            "self._elapsed > self.max_episode_steps",
            "adapters/test_adapter.py",
        ),
        ("self._elapsed[mask.view(self.num_envs)] = 0", "self._elapsed.zero_()", "adapters/test_adapter.py"),
        ("(episode_return - worst) / (solved - worst)", "episode_return / solved", "adapters/test_adapter.py"),
        ('self._elapsed = state_dict["elapsed"].clone()', "pass", "adapters/test_adapter.py"),
        ('self._starts = int(state_dict["times_begun"]) + 1', "self._starts = 0", "adapters/test_adapter.py"),
        ("self._env.close(raise_if_closed=False)", "pass", "adapters/test_adapter.py"),
        ("if len(env.batch_size) != 1", "if False", "adapters/test_adapter.py"),
        ("if not limit:", "if False:", "adapters/test_adapter.py"),
        ('"max_episode_steps", "max_episode_length"', '"max_episode_steps",', "adapters/test_autoreset.py"),
        ('"index" in inspect', '"mode" in inspect', "adapters/test_adapter.py"),
    ],
    "torchrl_mcp/adapters/reading.py": [
        ("self.half * action.clamp(-1.0, 1.0)", "self.half * action", "adapters/test_adapter.py"),
        ("if not vectors.isfinite().all()", "if False", "adapters/test_adapter.py"),
        ("if not spec.dtype.is_floating_point:", "if False:", "adapters/test_adapter.py"),
        ("if not (high - low).isfinite().all() or not (high > low).all():", "if False:", "adapters/test_adapter.py"),
        (".argmax(-1)", ".argmin(-1)", "adapters/test_gym.py"),
    ],
    "torchrl_mcp/adapters/gym.py": [
        ("if finals := [name for name in FINAL if name in info]", "if finals := []", "adapters/test_gym.py"),
        ("isinstance(wrapper, gymnasium.wrappers.Autoreset)", "False", "adapters/test_gym.py"),
    ],
    "torchrl_mcp/adapters/autoreset.py": [
        ("tensordict[key], observed)", "observed, observed)", "adapters/test_autoreset.py")
    ],
    # Distributions and networks
    "torchrl_mcp/distributions/multiplicative.py": [
        ("(precisions * loc).sum(-2)", "(precisions * loc).mean(-2)", "distributions/test_multiplicative.py"),
        ("gates.unsqueeze(-1) * scale", "scale", "distributions/test_multiplicative.py"),
        (".clamp_min(MIN_SCALE)", "", "distributions/test_multiplicative.py"),
        ("total < 0, torch.nan", "total < 0, 1.0", "distributions/test_validation.py"),
    ],
    "torchrl_mcp/distributions/additive.py": [
        ("(gates * function(actions)).sum(0)", "function(actions).mean(0)", "distributions/test_additive.py"),
        ("probs.argmax(-1)", "probs.argmin(-1)", "distributions/test_additive.py"),
        ("total > 0", "total >= 0", "distributions/test_validation.py"),
    ],
    "torchrl_mcp/distributions/squashed.py": [
        ("torch.as_tensor(self.half_width, dtype=x.dtype).log() + 2 *", "2 *", "distributions/test_squashed.py"),
        ("ordered is False or", "False and", "distributions/test_validation.py"),
    ],
    "torchrl_mcp/distributions/primitives.py": [
        ("(gates >= 0)", "(gates > 0)", "distributions/test_validation.py"),
        ("(scale > 0)", "(scale >= 0)", "distributions/test_validation.py"),
        ("negative = value < 0", "negative = value < -1", "distributions/test_validation.py"),
        ("check_signs(scale, gates)", "check_signs(gates, gates)", "distributions/test_validation.py"),
        ("if gates.shape[-1] != shape[-2]", "if False", "distributions/test_validation.py"),
    ],
    "torchrl_mcp/modules/gating.py": [
        ("activate_last_layer=True", "activate_last_layer=False", "modules/test_gating.py"),
        ("entropy.exp().mean()", "entropy.mean().exp()", "modules/test_gating.py"),
    ],
    "torchrl_mcp/modules/primitives.py": [
        ("math.log(initial_std) / std_gain", "math.log(initial_std)", "modules/test_primitives.py"),
        (
            "math.log(factor) / self.std_gain",
            "math.log(factor)",
            "methods/test_composite.py modules/test_primitives.py",
        ),
    ],
    "torchrl_mcp/modules/latent.py": [("clamp_min", "clamp_max", "modules/test_latent.py")],
    "torchrl_mcp/modules/normaliser.py": [
        ("(1 - share) * delta.square()", "delta.square()", "modules/test_normaliser.py"),
        (".clamp(-self.clip, self.clip)", "", "modules/test_normaliser.py"),
        ("if x.shape[-1:] != self.mean.shape", "if False", "modules/test_normaliser.py"),
        ("        x = x.to(self.mean.dtype)\n", "", "modules/test_normaliser.py"),
    ],
    "torchrl_mcp/modules/injection.py": [
        ("nn.init.zeros_(self.weight)", "nn.init.normal_(self.weight)", "modules/test_injection.py")
    ],
    # Methods
    "torchrl_mcp/methods/mcp.py": [
        ("rescale(initial_std / comp", "rescale(1.0 / comp", "methods/test_composite.py"),
        ("if loc.shape[-1] != sizes.action", "if False", "methods/test_composite.py"),
        ("for name, use in needs.items()", "for name, use in ()", "methods/test_composite.py"),
        ('stored=("gates", *PRIMITIVES)', 'stored=("gates",)', "methods/test_composite.py methods/test_contract.py"),
        ('    require_frozen("primitives", frozen, over="weights")\n', "", "methods/test_exploration_over_weights.py"),
    ],
    "conf/method/moe.yaml": [("override /mixer: additive", "override /mixer: multiplicative", "test_composition.py")],
    "torchrl_mcp/methods/scratch.py": [
        ("in_keys=[STATE, GOAL]", 'in_keys=["observation", GOAL]', "methods/test_contract.py")
    ],
    "torchrl_mcp/methods/critic.py": [("enabled=False", "enabled=True", "methods/test_critic.py")],
    "torchrl_mcp/methods/finetune.py": [
        (".requires_grad_(not blind)", ".requires_grad_(blind)", "methods/test_finetune.py")
    ],
    "torchrl_mcp/methods/hierarchical.py": [
        (
            "remainder(self.steps_per_choice) == 0",
            "remainder(self.steps_per_choice) == 1",
            "methods/test_option_actors.py",
        ),
        ('if "primitives" not in frozen', "if False", "methods/test_option_actors.py"),
    ],
    "torchrl_mcp/methods/option_critic.py": [
        ("(held_steps == 0) | ", "", "methods/test_option_actors.py"),
        ("= termination(terminations, held_option)", "= terminations[..., 0]", "methods/test_option_actors.py"),
    ],
    "torchrl_mcp/methods/options.py": [
        ("back = order.argsort()", "back = order", "methods/test_options.py methods/test_option_actors.py"),
        ("(1 - epsilon) * best + epsilon", "best + epsilon", "methods/test_options.py"),
    ],
    "torchrl_mcp/methods/latent_space.py": [
        ("if random else torch.zeros_like(loc)", "if random else torch.ones_like(loc)", "methods/test_latent_space.py"),
        ("@checked\ndef latent_parts", "def latent_parts", "methods/test_latent_space.py"),
    ],
    "torchrl_mcp/methods/transforms.py": [
        ("steps.masked_fill(begins, 0) + 1", "steps + 1", "methods/test_transforms.py"),
        ("value.masked_fill(mask.squeeze(-1), 0)", "value", "methods/test_transforms.py"),
    ],
    "torchrl_mcp/methods/sequence.py": [
        ("clamp(max=len(self.acts) - 1)", "remainder(len(self.acts))", "methods/test_sequence.py")
    ],
    # Objectives
    "torchrl_mcp/objectives/ppo.py": [
        ("mean.abs() - self.bound", "mean - self.bound", "objectives/test_ppo.py"),
        ("excess.square().sum(-1)", "excess.square().mean(-1)", "objectives/test_ppo.py"),
        ("entropy_bonus and entropy_coeff != 0", "entropy_bonus", "objectives/test_ppo.py"),
        ("if target.shape != values.shape", "if False", "objectives/test_values.py"),
        ("self.sampled = action", "pass", "training/test_update.py"),
    ],
    "torchrl_mcp/objectives/advantages.py": [
        ("    cut[..., -1] = True\n", "", "objectives/test_advantages.py"),
        ("& ~after", "& after", "objectives/test_advantages.py"),
        ("return 1 - gamma", "return 1.0", "objectives/test_advantages.py"),
        (".clamp(-clip, clip)", "", "objectives/test_advantages.py"),
        ("vectorized=False", "vectorized=True", "objectives/test_advantages.py"),
        ("@checked\n", "", "objectives/test_advantages.py"),
    ],
    "torchrl_mcp/objectives/latent.py": [("prior).sum(-1)", "prior).mean(-1)", "objectives/test_latent.py")],
    "torchrl_mcp/objectives/option_critic.py": [
        ("kept - of_option(terminations", "kept + of_option(terminations", "objectives/test_option_critic.py"),
        (
            "reward_scale + self.termination_cost",
            "reward_scale - self.termination_cost",
            "objectives/test_option_critic.py",
        ),
        ('regret * ~batch["next", "terminated"]', "regret", "objectives/test_option_critic.py"),
    ],
    "torchrl_mcp/objectives/semi_markov.py": [
        ("        done[..., -1, :] = True\n", "", "objectives/test_semi_markov.py"),
        (".masked_fill(terminated, 0.0)", "", "objectives/test_semi_markov.py"),
        ("if not begins.any()", "if False", "objectives/test_semi_markov.py"),
    ],
    "torchrl_mcp/objectives/symmetry.py": [
        ('self.mirrors["action"](self._mean(image))', "self._mean(image)", "objectives/test_symmetry.py"),
        ("<= self.tolerance", ">= self.tolerance", "objectives/test_symmetry.py"),
    ],
    # Environments
    "envs/rotations.py": [
        ("2 * (x * y + w * z)", "2 * (x * y - w * z)", "envs/test_rotations.py"),
        ("    q = torch.where(q[..., :1] < 0, -q, q)\n", "", "envs/test_rotations.py"),
        ("keepdim=True) < 0, -b, b)", "keepdim=True) < 0, b, b)", "envs/test_rotations.py"),
    ],
    "envs/observations.py": [
        (
            "one * cos + other * sin, other * cos - one * sin",
            "one * cos - other * sin, other * cos + one * sin",
            "envs/test_observations.py",
        ),
        ("(part * sign for part in quaternions)", "(part for part in quaternions)", "envs/test_observations.py"),
    ],
    "envs/base.py": [
        ("        return value.clone()\n", "        return value\n", "envs/test_own_task.py"),
        (
            "            terminated[diverged] = True\n",
            "",
            "envs/test_base.py envs/test_pd_character.py",
        ),
        ('["elapsed_steps"] >= self', '["elapsed_steps"] > self', "envs/test_base.py"),
        (
            "**{name: place[ids] for name, place in self._tracked.items()}, ",
            "",
            "envs/test_base.py envs/tasks/test_heading.py",
        ),
        ('self.generator.set_state(state["generator"].cpu())', "pass", "envs/test_base.py"),
        ("if value.shape != known[key].shape", "if False", "envs/test_base.py"),
        ("if action.shape != expected or", "if", "envs/test_base.py"),
    ],
    "envs/pd_character.py": [
        ("reward = reward.masked_fill(fallen, 0.0)", "reward = reward", "envs/test_pd_character.py"),
        ("fallen & self.terminate_on_fall", "fallen", "envs/test_pd_character.py"),
        (
            "if substeps < 1 or not math.isclose",
            "if substeps < 1 or False and math.isclose",
            "envs/tasks/test_arguments.py",
        ),
    ],
    "envs/initial_states.py": [
        ("shares < self.in_motion", "shares > self.in_motion", "envs/test_initial_states.py"),
        ("if library.character != character", "if False", "envs/test_initial_states.py"),
    ],
    "torchrl_mcp/adapters/contract.py": [
        ("(returns.mean() - standing)", "returns.mean()", "evaluation/test_rollout.py")
    ],
    "envs/characters/mirror.py": [
        (
            "BODY_SIGNS = (1, -1, 1, 1, -1, 1, -1,",
            "BODY_SIGNS = (1, -1, 1, 1, 1, -1, 1,",
            "envs/characters/test_mirror.py",
        ),
        ("torch.tensor([-1.0, 1.0, -1.0])", "torch.tensor([1.0, 1.0, -1.0])", "envs/characters/test_mirror.py"),
    ],
    "envs/characters/falls.py": [("heights - radii - ", "heights - radii + ", "envs/test_pd_character.py")],
    "envs/physics/batch.py": [
        ("        faults[failed] = True\n", "", "envs/physics/test_batch.py"),
        (
            "(values.max(axis) < LARGEST) & (values",
            "(values.max(axis) < LARGEST) | (values",
            "envs/physics/test_batch.py",
        ),
    ],
    "envs/tasks/rewards.py": [
        ("- speed).square()).exp()", "- speed).abs()).exp()", "envs/tasks/test_heading.py"),
        (
            "(distance >= ARRIVAL_DISTANCE)",
            "(distance <= ARRIVAL_DISTANCE)",
            "envs/tasks/test_location.py envs/tasks/test_rewards.py",
        ),
        (
            "healthy - control_weight * control",
            "healthy + control_weight * control",
            "envs/tasks/test_holdout.py envs/tasks/test_rewards.py",
        ),
        ("- speed).clamp(max=0.0)", "- speed)", "envs/tasks/test_rewards.py envs/tasks/test_transport.py"),
        (
            "target_distance_power / 2",
            "target_distance_power",
            "envs/tasks/test_rewards.py envs/tasks/test_transport.py",
        ),
        ("worth * (sum(weights) - idle)", "sum(weights) - idle", "envs/test_curriculum.py"),
    ],
    "envs/tasks/heading.py": [
        (
            'unit_vector(self.episode["direction"][ids] - self.heading(ids))',
            'unit_vector(self.episode["direction"][ids])',
            "envs/tasks/test_heading.py",
        ),
        ("0.0, 1.0) < self.change_probability", "0.0, 1.0) > self.change_probability", "envs/tasks/test_heading.py"),
    ],
    "envs/tasks/location.py": [
        ("stands & (self._alignment() > FACING)", "stands", "envs/tasks/test_location.py"),
        ('episode["reached"] |= ', 'episode["reached"] &= ', "envs/tasks/test_location.py"),
    ],
    "envs/tasks/carry.py": [
        ("        self._joint.active[opening] = 0\n", "", "envs/tasks/test_carry_success.py"),
        (
            'self.episode["taken"] & (self._joint.active == 0)',
            'self.episode["taken"]',
            "envs/tasks/test_carry_success.py",
        ),
    ],
    "envs/tasks/dribble.py": [
        (
            "self.com, self.object.position, SUCCESS_REACH",
            "self.com, self.com, SUCCESS_REACH",
            "envs/tasks/test_dribble.py envs/tasks/test_transport_success.py",
        )
    ],
    "envs/tasks/holdout.py": [
        ("[ids, 1:].flatten(1)", "[ids, :-1].flatten(1)", "envs/tasks/test_holdout.py"),
        ("~self.healthy() & self", "self.healthy() & self", "envs/tasks/test_holdout.py"),
    ],
    "envs/tasks/imitation.py": [
        (".masked_fill(self.terminated(), 0.0)", "", "envs/tasks/test_imitation.py"),
        ("ahead > self.library", "ahead < self.library", "envs/tasks/test_imitation.py"),
        (".argmin(0)", ".argmax(0)", "envs/tasks/test_imitation.py"),
        ('if state["motions"] != self.library.digest', "if False", "envs/tasks/test_imitation.py"),
        ("switch_candidates: Count", "switch_candidates: int", ARGUMENT),
    ],
    "envs/tasks/ranges.py": [
        ("bounds[:, 0].clamp_(min=clearance)", "bounds[:, 1].clamp_(min=clearance)", "envs/tasks/test_ranges.py"),
        ("if low < 0", "if False", "envs/tasks/test_arguments.py"),
    ],
    "envs/motions/clip.py": [
        (".qvel(steps[-1:])", ".qvel(steps[:1])", "envs/motions/test_clip.py"),
        ("if self.loop and (gap", "if False and (gap", "envs/motions/test_clip.py"),
    ],
    "envs/motions/library.py": [
        ("torch.floor(frames / last), 0.0)", "torch.ceil(frames / last), 0.0)", "envs/motions/test_library.py")
    ],
    "envs/motions/placement.py": [
        ("direction = (times - 1) / 2", "direction = times / 2", "envs/motions/test_placement.py")
    ],
    "envs/motions/capture/bvh.py": [
        (
            "multiply(rotations[:, index], turn)",
            "multiply(turn, rotations[:, index])",
            "envs/motions/capture/test_bvh.py",
        ),
        ("if declared != len(lines) or", "if", "envs/motions/capture/test_bvh.py"),
    ],
    "envs/motions/capture/amc.py": [
        ("* AXES[which]), turned)", "* AXES[which]), inverse(turned))", "envs/motions/capture/test_amc.py"),
        ("if start and number != expected", "if False", "envs/motions/capture/test_amc.py"),
    ],
    "envs/motions/capture/smpl.py": [
        ('up="y" if', 'up="z" if', "envs/motions/capture/test_smpl.py"),
        ("translations[:, 0] += root", "pass", "envs/motions/capture/test_smpl.py"),
    ],
    "envs/motions/capture/retarget.py": [
        (
            "leg_length(character) / body.leg_length()",
            "body.leg_length() / leg_length(character)",
            "envs/motions/capture/retarget",
        ),
        ("limb(side, ARM), forward=1.0", "limb(side, ARM), forward=-1.0", "envs/motions/capture/retarget"),
    ],
    "envs/motions/capture/fit.py": [
        (
            "if misread > 0.5",
            "if False",
            "envs/motions/capture/test_qpos.py envs/motions/capture/retarget/test_importer.py",
        )
    ],
    # Training
    "torchrl_mcp/training/trainer.py": [
        ("components if frames(path) else", "components if True else", FIRST),
        (
            "self.progress.iteration < self.settings.warmup_batches",
            "self.progress.iteration <= self.settings.warmup_batches",
            "training/test_trainer.py::test_in_the_warm_up_normalisers_and_critic_learn_and_the_policy_waits",
        ),
        (
            'if (name := f"{key}_normaliser") not in self.agent.frozen',
            'if (name := f"{key}_normaliser")',
            "training/test_trainer.py::test_a_transfer_of_a_transfer_keeps_the_width_of_the_primitives",
        ),
        ("            random=RunRandomness(agent.device),\n", "", BITS),
        ("            environment=source,\n", "", BITS),
        (
            "        self.agent.frozen.verify()",
            "        pass",
            "training/test_trainer.py::test_a_frozen_part_that_changes_stops_the_run",
        ),
    ],
    "torchrl_mcp/training/update.py": [
        ("        optimizer.zero_grad()\n", "", "training/test_update.py"),
        ('reports["actor"][-per_epoch:]', 'reports["actor"]', "training/test_update.py"),
        ('- 1 + mean["kl_approx"]', '- 1 - mean["kl_approx"]', "training/test_update.py"),
        (
            "if not math.isfinite(value)",
            "if False",
            "training/test_trainer.py::test_a_number_that_is_not_finite_stops_the_run_by_name_and_keeps_the_last_good_checkpoint",
        ),
        (
            "if self.frames_per_batch % self.num_envs or",
            "if",
            "training/test_update.py::test_settings_whose_batches_do_not_divide_are_refused",
        ),
        ('if "actor" in self.optimizers', "if False", "training/test_update.py"),
    ],
    "torchrl_mcp/training/checkpoint.py": [
        (
            "return archive.testzip() is None",
            "return True",
            "training/test_checkpoint.py training/test_damaged_checkpoint.py",
        ),
        (
            'if not name.endswith((".json", ".memmap"))',
            "if False",
            "training/test_checkpoint.py training/test_damaged_checkpoint.py",
        ),
    ],
    "torchrl_mcp/training/run_folder.py": [
        (
            "frames(path) >= 0), reverse=True",
            "frames(path) >= 0), reverse=False",
            "training/test_checkpoint.py training/test_run_folder.py",
        )
    ],
    "torchrl_mcp/training/metrics.py": [
        ('if int(row["iteration"]) <= iteration', 'if int(row["iteration"]) < iteration', "training/test_metrics.py"),
        ("if kept else 0) < iteration", "if kept else 0) < 0", "training/test_metrics.py"),
        ("            self.returns[done] = 0\n", "", "training/test_episodes.py"),
    ],
    "torchrl_mcp/training/transfer.py": [
        (
            "[..., before + entry.start : before + entry.stop]",
            "[..., entry.start : entry.stop]",
            "training/test_transfer.py",
        ),
        ("if normaliser not in freeze", "if False", "training/test_transfer.py"),
    ],
    "torchrl_mcp/training/collectors.py": [
        (
            "SeedSequence((self.seed, self._starts))",
            "SeedSequence((self.seed, 0))",
            "training/test_collectors.py::test_workers_that_start_again_have_other_seeds",
        ),
        (
            "if num_envs % num_workers",
            "if False",
            "training/test_collectors.py::test_environments_that_do_not_divide_evenly_are_refused",
        ),
    ],
    "torchrl_mcp/evaluation/diagnostics.py": [
        ("(output <= 0).all(0)", "(output <= 0).any(0)", "evaluation/test_dead_units.py")
    ],
    "torchrl_mcp/training/precision.py": [
        ('if autocast != "auto" and not isinstance(autocast, bool)', "if False", "training/test_precision.py")
    ],
    # Evaluation
    "torchrl_mcp/commands/train.py": [
        ("        sys.argv = former", "        pass", "commands/test_train.py"),
    ],
    "torchrl_mcp/commands/publish.py": [
        ("        output.unlink()", "        pass", "commands/test_publish.py"),
        ('parts[0].lstrip("+~")', "parts[0]", "commands/test_publish.py"),
    ],
    "torchrl_mcp/commands/demo.py": [
        ('runs["scratch"].training.total_frames +=', "_ =", "commands/test_demo.py"),
    ],
    "torchrl_mcp/evaluation/rollout.py": [
        (
            "reward * running",
            "reward",
            "evaluation/test_rollout.py",
        ),
        (
            "metrics_of_step[SUCCESS] & ~terminated",
            "metrics_of_step[SUCCESS]",
            "evaluation/test_rollout.py envs/tasks/test_transport_success.py",
        ),
        (
            'terminated |= running & outcome["terminated"]',
            'terminated |= outcome["terminated"]',
            "evaluation/test_rollout.py",
        ),
        (
            "{name: total / lengths for",
            "{name: total / len(decisions) for",
            "evaluation/test_rollout.py",
        ),
        (
            '"normalised_return": normalised.mean()',
            '"normalised_return": normalised.max()',
            "evaluation/test_rollout.py",
        ),
    ],
    "torchrl_mcp/evaluation/statistics.py": [
        ("axis=axis), 0.25, axis=axis", "axis=axis), 0.1, axis=axis", "evaluation/test_statistics.py"),
        ("ddof=1", "ddof=0", "evaluation/test_statistics.py"),
        ("samples[0].mean(axis) -", "samples[0].mean(axis) +", "evaluation/test_statistics.py"),
        ("CONFIDENCE = 0.95", "CONFIDENCE = 0.8", "evaluation/test_statistics.py"),
    ],
    "torchrl_mcp/evaluation/clips.py": [("if env.num_envs % count", "if False", "evaluation/test_clips.py")],
    # Runs
    "torchrl_mcp/runs/identity.py": [
        (
            'name.startswith(f"{setting}.")',
            "name.startswith(setting)",
            "runs/test_identity.py report/test_comparison.py",
        ),
        ('f"pretrained-{mark}"', '"pretrained"', NETWORKS),
        ("if wanted.get(key) == value)}", "if wanted.get(key) != value)}", "runs/test_identity.py"),
    ],
    "torchrl_mcp/runs/provenance.py": [
        ('f"{head}-dirty" if', "head if", "runs/test_provenance.py"),
        ('[f":(exclude){results}"] if results', '[":(exclude)*"] if results', "runs/test_provenance.py"),
        ('*origin.get("extended", []), entry', "entry", LONGER),
    ],
    "torchrl_mcp/runs/lock.py": [
        ("or not _is_current(file, folder)", "", "runs/test_lock.py"),
        ("    if wait:\n        return False\n", "", "runs/test_lock.py"),
    ],
    "torchrl_mcp/runs/benchmark.py": [
        (
            "waiting = [job for job in jobs if not is_complete(job.folder)]",
            "waiting = list(jobs)",
            "runs/test_benchmark.py::test_a_benchmark_that_is_complete_does_nothing_and_says_so_on_however_many_threads",
        ),
        (
            "if job.needs is None or is_complete(job.needs)",
            "if True",
            "runs/test_benchmark.py::test_a_failed_run_is_named_with_its_log_and_stops_only_what_needs_it",
        ),
        (
            "if conflicts := [line for job in jobs if (line := conflict(job))]",
            "if conflicts := []",
            "runs/test_benchmark.py::test_a_folder_of_other_settings_is_not_taken_for_done",
        ),
        (
            "    require_own_folders(jobs)\n",
            "",
            "runs/test_benchmark.py::test_settings_that_folders_do_not_tell_apart_are_not_varied",
        ),
        (
            "if unknown := [value for value in choices[key] if value not in available]",
            "if unknown := []",
            "runs/test_benchmark.py::test_arguments_that_fit_no_row_are_refused_with_the_rows",
        ),
    ],
    "torchrl_mcp/runs/status.py": [
        ("if frames >= total:  #", "if True:  #", "runs/test_status.py"),
        ("{**earlier, **runs}", "runs", "runs/test_status.py"),
        ("with lock.hold(folder, wait=True):", "if True:", "runs/test_status.py"),
        ('line.count(",") == names.count(",")', 'line.count(",")', "runs/test_status.py"),
        ("run_folder.frames(path) >= total", "run_folder.frames(path) > total", "runs/test_status.py"),
    ],
    "torchrl_mcp/runs/experiment.py": [
        (
            'devices=[device] if device.type == "cuda" else []',
            "devices=[]",
            "runs/test_experiment.py::test_the_rehearsal_of_the_evaluation_uses_up_no_random_numbers_of_a_gpu",
        ),
        (
            "if checkpoint.is_intact(path)), saved[0])",
            "), saved[0])",
            "runs/test_faults.py::test_a_damaged_newest_checkpoint_is_set_aside_and_the_run_goes_on_from_the_one_before",
        ),
        (
            "if changed := records.changes(folder, plan.config)",
            "if changed := []",
            "commands/test_sweep.py::test_the_folder_of_a_run_with_other_settings_is_refused_and_left_alone",
        ),
    ],
    "torchrl_mcp/runs/records.py": [
        (
            "if changed := differences(saved, wanted, SAME_RUN",
            "if changed := differences(saved, saved, SAME_RUN",
            "runs/test_faults.py::test_a_run_whose_files_do_not_fit_is_not_resumed",
        ),
        (
            "if total != planned and total <",
            "if False and total <",
            "runs/test_faults.py::test_a_resume_to_the_length_that_was_planned_ends_a_run_of_whole_batches",
        ),
        ("recorded.get(setting, mark) != mark", "False", BODY),
    ],
    "torchrl_mcp/runs/places.py": [("member.CRC) for member", "member.file_size) for member", NETWORKS)],
    # Validation of settings
    "torchrl_mcp/values.py": [
        ("is_whole(value) and value >= 1)", "is_whole(value) and value >= 0)", VALUE),
        ("0 <= n < SEEDS)", "0 <= n <= SEEDS)", VALUE),
        ('Rule("a finite number above 0", lambda value: is_number(value) and value > 0)', 'Rule("", is_number)', VALUE),
        ("is_number(value) and 0 <= value < 1)", "is_number(value) and 0 <= value <= 1)", VALUE),
        (" and math.isfinite(value)", "", VALUE),
        ("isinstance(value, Integral) and not isinstance(value, bool)", "isinstance(value, Integral)", VALUE),
        ("len(value) == 2 and value[0] <= value[1]", "len(value) == 2", VALUE),
        ("is_whole(item) and item >= 1) and len(value) > 0", "is_whole(item) and item >= 1)", VALUE),
        ("isinstance(value, bool) == isinstance(choice, bool)", "True", "test_values.py"),
        ("if len(alternatives) < len(rules):", "if False:", "test_values.py"),
        ("                require(name, value, types_of(function).get(name))", "                pass", ARGUMENT),
    ],
    "torchrl_mcp/runs/validation.py": [
        (
            "if not low <= actor <= high",
            "if False",
            "runs/test_validation.py::test_a_step_size_that_the_first_update_would_replace_is_refused",
        ),
        (
            "if batch % num_envs or",
            "if",
            "runs/test_validation.py::test_a_batch_that_does_not_divide_is_refused_with_the_numbers_of_the_settings",
        ),
        ('if path.startswith("~")', "if False", PLACE),
        (
            "if steps < steps_per_choice",
            "if False",
            "runs/test_validation.py::test_a_batch_that_may_contain_no_choice_is_refused",
        ),
        ('if value == "???"', "if False", "runs/test_validation.py::test_a_missing_value_is_asked_for"),
        ("if not home and _escapes", "if False and _escapes", PLACE),
        ("is_group(value) and (rule is None or rule.allows(value))", "is_group(value)", GROUP),
        ('("pretrain", "transfer", "evaluation"), environment', '("pretrain", "transfer"), environment', INHERITED),
        ("if wrong := list(wrong_values(given, types)):", "if wrong := []:", GIVEN),
    ],
    "torchrl_mcp/runs/arguments.py": [
        ("for called in reversed(_called(name)):", "for called in _called(name)[:1]:", INHERITED),
        (
            "if unknown and not is_open(taken)",
            "if False",
            "runs/test_keys.py::test_an_argument_that_a_class_does_not_take_is_named_with_the_nearest",
        ),
    ],
    "torchrl_mcp/runs/imports.py": [
        ("if characters and character not in characters", "if False", "runs/test_remedies.py"),
        ("    require_trusted(config, source)\n", "", "runs/test_trust.py"),
    ],
    "torchrl_mcp/runs/requirements.py": [
        ("if lines := [f", "if False and [f", KEY),
        ('if name not in ("defaults", "hydra", *cfg)]', "if False]", KEY),
        ('if kind_of_device == "cuda" and not', "if False and not", "runs/test_remedies.py"),
        ('if kind_of_device == "mps"', "if False", "runs/test_remedies.py"),
        ('if kind != "csv" and find_spec(kind) is None', "if False", "runs/test_remedies.py"),
        (
            'if cfg.physics.on_device and "num_workers"',
            'if False and "num_workers"',
            "runs/test_physics.py::test_an_engine_that_cannot_simulate_is_refused",
        ),
        (
            "if unread := [name for name in given if",
            "if unread := [name for name in given if False and",
            "runs/test_remedies.py",
        ),
        ("and cfg.transfer.keep and cfg.pretrained is None", "and False", "runs/test_remedies.py"),
        (
            "    if not missing:\n        return\n",
            "    return\n",
            "runs/test_places.py::test_motions_are_found_from_every_folder_and_missed_by_the_name_of_their_setting",
        ),
    ],
    "torchrl_mcp/runs/trust.py": [
        ('if any("${" in f"{name}{value}" for name, value in leaves(config))', "if False", "runs/test_trust.py"),
        ("if path.stat().st_size > LARGEST", "if False", "runs/test_trust.py"),
        ("if depth > DEEPEST", "if False", "runs/test_trust.py"),
        ("if isinstance(event, yaml.AliasEvent)", "if False", "runs/test_trust.py"),
    ],
    # Reports
    "torchrl_mcp/report/cell.py": [
        ("return is_item or", "return", "report/test_comparison.py"),
        ("or is_of_curriculum or", "or", "report/test_comparison.py"),
        ("or name in groups or", "or", "report/test_comparison.py"),
        ("in (2, 3)", "in (2, 3, 4)", "report/test_cell.py report/test_table_2.py report/test_report.py"),
        ("return ours.value - self.reported.mean", "return self.reported.mean - ours.value", "report/test_cell.py"),
        ("len({run.seed for run in self.runs})", "len(self.runs)", "report/test_cell.py report/test_report.py"),
        (
            'run.evaluation[mode]["normalised_return"]',
            'run.evaluation["deterministic"]["normalised_return"]',
            "report/test_cell.py report/test_report.py",
        ),
    ],
    "torchrl_mcp/report/table_2.py": [
        ('(max if method == "scratch" else min)', "min", "report/test_table_2.py"),
        ("candidates = full or candidates", "pass", "report/test_table_2.py"),
    ],
    "torchrl_mcp/report/comparison.py": [
        ("set() if _explores(run) else", "set() if True else", "report/test_comparison.py report/test_cell.py"),
        ("if len(group) > 1\n    ]", "if group\n    ]", "report/test_comparison.py"),
    ],
    "torchrl_mcp/report/results.py": [
        ('self.settings.get(f"task.{self.stage}.{key}")', "None", "report/test_results.py"),
        ("if self.frames < self.total_frames", "if self.frames <= self.total_frames", "report/test_results.py"),
        (
            "if not math.isfinite(value):\n                raise",
            "if False:\n                raise",
            "report/test_damaged_runs.py",
        ),
    ],
    # The viewer
    "torchrl_mcp/viewer/steering.py": [
        ("min(max(speed, speeds[0]), speeds[1])", "speed", "viewer/test_steering.py"),
        ('env.episode["elapsed_steps"][0] = 0', "pass", "viewer/test_steering.py"),
        ("min(max(weight, 0.0), 1.0)", "weight", "viewer/test_steering.py"),
        ("self.play_next_alone(-sign)", "self.play_next_alone(sign)", "viewer/test_steering.py"),
    ],
}
"""Of a file: a text, what replaces it, and files in ``tests``, or tests in slow ones, of which one must fail then."""


def faults():
    """Yield all faults: file, old text, new text, and paths of tests."""
    for file, replacements in FAULTS.items():
        for old, new, tests in replacements:
            yield file, old, new, [f"tests/{test}" for test in tests.split()]


def copied(folder):
    """Copy the project's files to a folder in which envs and conf are inside the package, as Python sees them."""
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    for name in ("envs", "conf"):
        (folder / "torchrl_mcp" / name).symlink_to(Path("..") / name)
    subprocess.run(
        "git init -q && git add . && git -c user.name=- -c user.email=- commit -qm -", shell=True, cwd=folder
    )


class Failures:
    """Writes the names of tests that fail into a file."""

    def __init__(self, path):
        self.path = path

    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.path.write_text(report.nodeid)


def failure(folder, tests):
    """Run tests on the copy, and return the first that fails, or an empty text.

    A fork saves what a new process would import: most of the time of most tests.
    """
    failed, output = folder / "failed", folder / "output"
    failed.write_text("")
    if not (process := os.fork()):
        with output.open("w") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        options = ["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow"]
        os._exit(pytest.main([*options, *tests], plugins=[Failures(failed)]))
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    if code not in (0, 1):
        print(output.read_text()[-4000:])  # no tests were run
    return failed.read_text()


def outcome(folder, file, old, new, tests):
    """Put one fault into the copy, and say what came of it."""
    text = (ROOT / file).read_text(encoding="utf-8")
    if text.count(old) != 1:
        return f"is {text.count(old)} times in its file"
    try:
        (folder / file).write_text(text.replace(old, new), encoding="utf-8")
        failed = failure(folder, tests)
    finally:
        (folder / file).write_text(text, encoding="utf-8")
    if failed and failure(folder, [failed]):
        return f"cannot be told: {failed} fails without it, too"
    return "caught" if failed else "survived"


def main(words):
    """Try the faults, print a line for each, and end with 1 unless all are caught."""
    chosen = [fault for fault in faults() if not words or any(word in repr(fault) for word in words)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        copied(folder)
        os.chdir(folder)
        os.environ |= {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
        sys.path[:0] = [str(folder)]
        sys.dont_write_bytecode = True
        used = find_spec("torchrl_mcp").origin
        assert used == str(folder / "torchrl_mcp/__init__.py"), f"{used} would be tested instead of the copy"
        assert "torchrl_mcp" not in sys.modules, "the package was imported before the fault"
        caught = 0
        for number, (file, old, new, tests) in enumerate(chosen, start=1):
            begun = time.monotonic()
            result = outcome(folder, file, old, new, tests)
            caught += result == "caught"
            line = f"{number:3} {result:8} {file}: {old.strip()!r} -> {new.strip()!r}"
            print(f"{line} ({time.monotonic() - begun:.0f} s)", flush=True)
    print(f"{caught} of {len(chosen)} faults are caught")
    sys.exit(caught != len(chosen))


if __name__ == "__main__":
    main(sys.argv[1:])
