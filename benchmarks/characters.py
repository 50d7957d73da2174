"""Measurements behind the characters' physics, and a stress test.

    python benchmarks/characters.py timestep    # half an hour, writes results/characters_timestep.csv
    python benchmarks/characters.py stress      # hours, writes results/characters_stress.csv

``--quick`` takes a minute, measures less and writes nothing unless given ``--output``.

*timestep* compares settings of MuJoCo by accuracy and by speed.

- Accuracy: root mean square difference of all joint angles (rotation vectors of ball joints, in radians) from the same
  motion at a time step of 1/3000 s, over one second of control at 30 Hz and 8 seeds. ``smooth`` are sinusoids of
  0.3 rad at 1 to 2 Hz in free space; ``noise`` is normal, 0.1 of half the range of the targets, in free space;
  ``ground`` are sinusoids of 0.1 rad from standing. Diverged motions have no number.
- Speed: control steps per second of processor time, which other work on the machine hardly affects, of 256 simulations
  that stand, stumble and fall with that noise for two seconds. Settings take turns; the result is the mean of two
  rounds.
- ``pd_only`` is the character without armature and with all its damping in the actuators: at 1/3000 s it shows the
  effect of these two; at longer time steps, MuJoCo's behaviour without them (it prints warnings then).

*stress* draws targets uniformly within their bounds for 10,000 control steps of 256 simulations, and for a tenth of the
steps with self-collision. Every 300 steps one half is reset to standing, and the other half 1 m higher with a random
orientation. ``diverged`` counts simulations that MuJoCo could not continue, ``warnings`` its warnings; the others are
maxima in J, rad/s and m/s.
"""

import argparse
import os
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

import tensordict  # noqa: F401 - before mujoco, see envs/__init__.py

# isort: split
import mujoco
import torch
from report import about, table, write
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.physics.batch import BatchSimulation
from torchrl_mcp.envs.rendering.ground import add_ground

RESULTS = Path(__file__).resolve().parent / "results"
CONTROL_RATE = 30
REFERENCE_RATE = 3000
SEEDS = 8
PEAKS = ("kinetic_energy", "joint_velocity", "root_velocity")


class Setting(NamedTuple):
    """Options of MuJoCo and of the character."""

    rate: int
    integrator: str = "implicitfast"
    iterations: int = 100
    cone: str = "pyramidal"
    self_collision: str = "none"
    pd_only: bool = False


SETTINGS = [
    *(
        Setting(rate, integrator)
        for rate in (60, 120, 240, 480)
        for integrator in ("implicitfast", "implicit", "Euler")
    ),
    Setting(990),
    Setting(120, iterations=3),
    Setting(120, iterations=10),
    Setting(120, cone="elliptic"),
    Setting(120, self_collision="legs"),
    Setting(120, self_collision="all"),
    *(Setting(rate, pd_only=True) for rate in (120, 480, 990, 3000)),
]
QUICK_SETTINGS = [Setting(60), Setting(120), Setting(120, self_collision="legs")]


def scene(character: str, setting: Setting, *, ground: bool = True) -> mujoco.MjModel:
    """Compile a character on the ground, or in free space: without gravity and contacts."""
    spec = CHARACTERS[character].spec(self_collision=setting.self_collision == "all")
    if setting.self_collision == "legs":
        let_legs_collide(spec)
    add_ground(spec)
    spec.option.timestep = 1 / setting.rate
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{setting.integrator.upper()}")
    spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{setting.cone.upper()}")
    spec.option.iterations = setting.iterations
    model = spec.compile()
    if setting.pd_only:
        joints = model.actuator_trnid[:, 0]
        model.actuator_biasprm[:, 2] -= model.dof_damping[model.jnt_dofadr[joints]]
        model.dof_damping[:] = model.dof_armature[:] = 0
    if not ground:
        model.opt.gravity[:] = 0
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return model


def let_legs_collide(spec: mujoco.MjSpec) -> None:
    """Let the right leg collide with the left leg only."""
    for side, contype, conaffinity in (("right", 2, 5), ("left", 4, 3)):
        hip = spec.body(f"{side}_hip")
        for body in (hip, *hip.find_all(mujoco.mjtObj.mjOBJ_BODY)):
            for geom in body.geoms:
                if geom.conaffinity:
                    geom.contype, geom.conaffinity = contype, conaffinity


def simulate(model: mujoco.MjModel, num_envs: int, threads: int, *outputs: str) -> BatchSimulation:
    """Make simulations with 30 control steps per second, in the initial state."""
    substeps = round(1 / (CONTROL_RATE * model.opt.timestep))
    simulation = BatchSimulation(
        model, num_envs, substeps=substeps, outputs=outputs, num_threads=threads, persistent=True, current=True
    )
    simulation.reset(torch.arange(num_envs), {})
    return simulation


def half_range(model: mujoco.MjModel) -> Tensor:
    """Half the width of the range of each target, shape ``(A,)``."""
    return torch.from_numpy(model.actuator_ctrlrange @ [-0.5, 0.5])


def sinusoids(model: mujoco.MjModel, amplitude: float) -> Tensor:
    """Targets that start at rest and oscillate at 1 to 2 Hz, shape ``(T, SEEDS, A)``."""
    generator = torch.Generator().manual_seed(0)
    frequency, phase = torch.rand(2, SEEDS, model.nu, generator=generator, dtype=torch.float64)
    frequency, phase = 2 * torch.pi * (1 + frequency), 2 * torch.pi * phase
    seconds = torch.arange(CONTROL_RATE).view(-1, 1, 1) / CONTROL_RATE
    return amplitude * ((frequency * seconds + phase).sin() - phase.sin())


def noise(model: mujoco.MjModel, steps: int, num_envs: int) -> Tensor:
    """Targets of exploration around the rest pose, shape ``(T, N, A)``."""
    generator = torch.Generator().manual_seed(0)
    return 0.1 * half_range(model) * torch.randn(steps, num_envs, model.nu, generator=generator, dtype=torch.float64)


MOTIONS: dict[str, tuple[bool, Callable[[mujoco.MjModel], Tensor]]] = {
    "smooth": (False, lambda model: sinusoids(model, 0.3)),
    "noise": (False, lambda model: noise(model, CONTROL_RATE, SEEDS)),
    "ground": (True, lambda model: sinusoids(model, 0.1)),
}
"""Motions by name: whether there is ground, and the targets."""


@cache
def play(character: str, setting: Setting, motion: str, threads: int) -> Tensor:
    """Joint angles after each control step, shape ``(T, SEEDS, A)``, or NaN if a simulation diverged."""
    ground, targets = MOTIONS[motion]
    simulation = simulate(model := scene(character, setting, ground=ground), SEEDS, threads, "actuator_length")
    angles = []
    for ctrl in targets(model):
        if len(simulation.step(ctrl)):
            return torch.tensor(torch.nan)
        angles.append(simulation.outputs["actuator_length"].clone())
    return torch.stack(angles)


def accuracy(character: str, setting: Setting, threads: int) -> dict[str, str]:
    """Root mean square error of each motion in radians; empty for diverged motions."""
    reference = Setting(REFERENCE_RATE, self_collision=setting.self_collision)
    errors = {
        motion: play(character, setting, motion, threads) - play(character, reference, motion, threads)
        for motion in MOTIONS
    }
    rms = {motion: error.square().mean().sqrt().item() for motion, error in errors.items()}
    return {motion: f"{value:.4f}" if value < 10 else "" for motion, value in rms.items()}


def speed(character: str, setting: Setting, num_envs: int, threads: int) -> float:
    """Control steps of simulations that stand, stumble and fall, per second of processor time."""
    simulation = simulate(model := scene(character, setting), num_envs, threads)
    targets = noise(model, 2 * CONTROL_RATE, num_envs)
    start = time.process_time()
    for ctrl in targets:
        simulation.step(ctrl)
    return len(targets) * num_envs / (time.process_time() - start)


def compare(character: str, settings: list[Setting], rounds: int, num_envs: int, threads: int) -> list[dict[str, Any]]:
    """Return a row per setting, with errors and speed."""
    rows = [accuracy(character, setting, threads) for setting in settings]
    timed = [setting for setting in settings if setting.rate < 990 and not setting.pd_only]
    speeds: dict[Setting, list[float]] = {setting: [] for setting in timed}
    for _ in range(rounds):
        for setting in timed:
            speeds[setting].append(speed(character, setting, num_envs, threads))
    means = {setting: round(mean(values)) for setting, values in speeds.items()}
    return [
        {"character": character, **setting._asdict(), **row, "steps_per_cpu_second": means.get(setting, "")}
        for setting, row in zip(settings, rows, strict=True)
    ]


def random_rotations(num: int, generator: torch.Generator) -> Tensor:
    """Quaternions, uniform over all orientations, shape ``(N, 4)``."""
    quaternions = torch.randn(num, 4, generator=generator, dtype=torch.float64)
    return quaternions / quaternions.norm(dim=-1, keepdim=True)


def stress(character: str, self_collision: str, steps: int, num_envs: int, threads: int) -> list[dict[str, Any]]:
    """Return the rows of a character under random actions, one per kind of initial state."""
    model = scene(character, Setting(120, self_collision=self_collision))
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    simulation, generator = simulate(model, num_envs, threads, "energy"), torch.Generator().manual_seed(0)
    half, middle = half_range(model), torch.from_numpy(model.actuator_ctrlrange.mean(-1))
    everyone = torch.arange(num_envs)
    groups = {"standing": everyone[: num_envs // 2], "dropped": everyone[num_envs // 2 :]}
    peaks, diverged = torch.zeros(num_envs, 3, dtype=torch.float64), torch.zeros(num_envs, dtype=torch.int64)
    before, clock = logged_warnings(), time.perf_counter()
    for step in range(steps):
        if step % 300 == 0:
            qpos = torch.from_numpy(model.qpos0).repeat(num_envs, 1)
            qpos[groups["dropped"], 2] += 1
            qpos[groups["dropped"], 3:7] = random_rotations(len(groups["dropped"]), generator)
            simulation.reset(everyone, {"qpos": qpos})
        uniform = 2 * torch.rand(num_envs, model.nu, generator=generator, dtype=torch.float64) - 1
        faults = simulation.step(middle + half * uniform)
        if len(faults):
            diverged[faults] += 1
            simulation.reset(faults, {})
        velocity, energy = simulation.state["qvel"].abs(), simulation.outputs["energy"][:, 1]
        peaks = peaks.max(torch.stack([energy, velocity[:, 6:].amax(-1), velocity[:, :3].amax(-1)], -1))
    seconds, warnings = time.perf_counter() - clock, logged_warnings() - before
    return [
        {
            "character": character,
            "self_collision": self_collision,
            "start": start,
            "steps": steps,
            "num_envs": len(group),
            "diverged": diverged[group].sum().item(),
            "warnings_of_both": warnings,
            **dict(zip(PEAKS, [round(peak, 1) for peak in peaks[group].amax(0).tolist()], strict=True)),
            "steps_per_second_of_both": round(steps * num_envs / seconds),
        }
        for start, group in groups.items()
    ]


def logged_warnings() -> int:
    """Count the warnings in MuJoCo's log in the working directory."""
    log = Path("MUJOCO_LOG.TXT")
    return log.read_text().count("WARNING") if log.exists() else 0


def timestep(args: argparse.Namespace) -> Iterator[list[dict[str, Any]]]:
    """Compare settings, character by character."""
    settings, rounds, num_envs = (QUICK_SETTINGS, 1, 16) if args.quick else (SETTINGS, 2, 256)
    for character in args.characters:
        yield compare(character, settings, rounds, num_envs, args.threads)


def strain(args: argparse.Namespace) -> Iterator[list[dict[str, Any]]]:
    """Stress every character without self-collision, and for a tenth of the steps with it."""
    steps, num_envs = (60, 16) if args.quick else (10_000, 256)
    for character in args.characters:
        yield stress(character, "none", steps, num_envs, args.threads)
        yield stress(character, "all", steps // 10, num_envs, args.threads)


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["timestep", "stress"])
    parser.add_argument("--characters", nargs="+", choices=CHARACTERS, default=list(CHARACTERS))
    parser.add_argument("--quick", action="store_true", help="measure less")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="threads of the physics")
    parser.add_argument("--output", type=Path, help="CSV file; without --quick there is a default")
    args = parser.parse_args()
    tables = timestep(args) if args.what == "timestep" else strain(args)
    rows = []
    for part in tables:
        print(table(part), flush=True)
        rows += part
    if output := args.output or (None if args.quick else RESULTS / f"characters_{args.what}.csv"):
        conditions = {"threads": args.threads, **about()}
        write(output, [{**row, **conditions} for row in rows])
        print(f"written to {output}")


if __name__ == "__main__":
    main()
