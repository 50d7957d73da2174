"""Pre-training by imitation: how well MCP's primitives follow reference motions.

Every character learns with ``method=mcp task=imitation stage=pretrain preset=fast width=1.0 action_std=0.1`` from the
generated corpus, in the character's ``PHASES``: the last step and settings of the task of each. Called again, the
script resumes. It writes learning curves, returns with changing references, the tracking of every clip and films to
``benchmarks/results``, and with ``--publish`` the built-in networks to ``torchrl_mcp/networks``.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from omegaconf import OmegaConf
from report import about, write

from torchrl_mcp.analysis import draw_curves, learning_curves, read_metrics, write_curves
from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.runs import policies
from torchrl_mcp.runs.builtin import FOLDER
from torchrl_mcp.training import checkpoint
from torchrl_mcp.training.run_folder import CONFIG, replacing
from torchrl_mcp.viewer.film import save_film

RESULTS = Path(__file__).resolve().parent / "results"
ANY, LOST, CHANGING = {"switch_candidates": 1}, {"failure_weighting": 0.5}, {"switch_interval": 1.5}
SIMILAR = {"switch_candidates": 16, "switch_interval": 3.0}
PHASES: dict[str, list[tuple[int, dict[str, float]]]] = {
    "biped": [
        (4_505_600, ANY),
        (6_348_800, LOST),
        (7_987_200, CHANGING),
        (11_264_000, SIMILAR),
        (13_312_000, CHANGING),
    ],
    "humanoid": [
        (3_686_400, ANY),
        (5_120_000, LOST),
        (6_553_600, CHANGING),
        (9_216_000, SIMILAR),
        (10_649_600, CHANGING),
    ],
    "trex": [(4_096_000, ANY)],
}
COMMON = ["method=mcp", "task=imitation", "stage=pretrain", "preset=fast", "width=1.0", "action_std=0.1"]
MACHINE = ["logger=none", "torch_threads=1", "num_threads=1", "progress_bar=false", "checkpoint_interval=50"]
EVALUATION_SEED = 12345
CHANGES = {"to one of 16 moments": 16, "to any moment": 1}
"""Number of random moments of which the most similar becomes the reference, when it changes."""


def main() -> None:
    """Train missing runs, evaluate, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--output", type=Path, default=Path("runs/imitation"), help="folder of the run folders")
    parser.add_argument("--characters", nargs="+", default=list(PHASES), choices=PHASES)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="runs at a time, one core each")
    parser.add_argument("--report", action="store_true", help="train nothing: report the runs as far as they are")
    parser.add_argument("--publish", action="store_true", help="write the networks that come with the library, too")
    parser.add_argument("--episodes", type=int, default=256, help="with changing references, of each evaluation")
    parser.add_argument("--episodes-per-clip", type=int, default=16)
    arguments = parser.parse_args()
    runs = {character: arguments.output / f"imitation-{character}" for character in arguments.characters}
    if not arguments.report:
        with ThreadPoolExecutor(arguments.jobs) as pool:
            list(pool.map(train, runs.values(), runs))
    report(runs, arguments.episodes, arguments.episodes_per_clip)
    if arguments.publish:
        for character, run in runs.items():
            policies.publish_run(run, FOLDER / f"mcp-{character}.torchrl")


def train(run: Path, character: str) -> None:
    """Train a character in a separate process, or resume its run."""
    for steps, settings in PHASES[character]:
        if (run / CONFIG).exists():
            set_phase(run, steps, settings)
            arguments = [f"resume={run}"]
        else:
            phase = [f"+imitation.{name}={value}" for name, value in settings.items()]
            facts = [f"character={character}", f"training.total_frames={steps}", f"run_dir={run}"]
            arguments = [*COMMON, *MACHINE, *facts, *phase]
        command = [sys.executable, "-m", "torchrl_mcp.cli.train", *arguments]
        subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def set_phase(run: Path, steps: int, settings: Mapping[str, float]) -> None:
    """Set the last step and the task's settings of a run's next phase."""
    cfg = OmegaConf.load(run / CONFIG)
    cfg.training.total_frames = steps
    cfg.imitation.update(settings)
    cfg.task.pretrain.update(settings)
    with replacing(run / CONFIG) as partial:
        OmegaConf.save(cfg, partial)


def report(runs: dict[str, Path], episodes: int, episodes_per_clip: int) -> None:
    """Write tables, curves and films to ``benchmarks/results``."""
    facts = {character: cost(run) for character, run in runs.items()}
    rows, clips = [], []
    for character, run in runs.items():
        for changes, candidates in CHANGES.items():
            for mode, numbers in evaluate(run, episodes, candidates).items():
                case = {"character": character, "changes": changes, "mode": mode}
                rows.append(case | facts[character] | numbers | about())
                print(*case.values(), f"{numbers['completed']:.0%}, {numbers['tracking_error']:.3f} m", flush=True)
        followed = policies.evaluate_clips(run, episodes=episodes_per_clip, seed=EVALUATION_SEED)
        clips += [{"character": character, **asdict(clip)} for clip in followed]
    write(RESULTS / "imitation.csv", rows)
    write(RESULTS / "imitation_clips.csv", clips)
    curves = learning_curves({character: [run] for character, run in runs.items()}, quantity="episode/length")
    write_curves(curves, RESULTS / "imitation_curves.csv")
    save_figure(draw_curves(curves, ylabel="control steps per episode"), RESULTS / "imitation_curves")
    for character, run in runs.items():
        _, agent, env = policies.restore(run, num_envs=1, seed=EVALUATION_SEED)
        save_film(agent.actor.policy, env, RESULTS / f"imitation_{character}.gif")


def evaluate(run: Path, episodes: int, candidates: int) -> dict[str, dict[str, float]]:
    """Return the results of a run, deterministic and stochastic, with changing references."""
    # Every episode lasts 10 s, so that completion means the same everywhere.
    changing = {"clip_end": "switch", "switch_interval": 5.0, "switch_candidates": candidates}
    evaluation = policies.evaluate_run(run, episodes=episodes, seed=EVALUATION_SEED, **changing)
    for numbers in evaluation.values():
        numbers["completed"] = 1 - numbers.pop("terminated")
        numbers["tracking_error"] = numbers.pop("metrics")["tracking_error"]
        del numbers["diagnostics"]
    return evaluation


def cost(run: Path) -> dict[str, float]:
    """Steps and seconds of training up to the newest checkpoint."""
    frames = int(checkpoint.find(run).stem.partition("-")[2])
    seconds = next(row["seconds"] for row in read_metrics(run) if row["frames"] == frames)
    return {"frames": frames, "training_seconds": round(seconds), "steps_per_second": round(frames / seconds)}


if __name__ == "__main__":
    main()
