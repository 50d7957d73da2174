"""Contacts and constraints of characters that fall and lie about, beside the memory that MuJoCo Warp has for them.

    python benchmarks/contact_room.py            # minutes on Warp's CPU device, writes results/contact_room.csv
    python benchmarks/contact_room.py --quick    # seconds for each scene, writes nothing unless given --output

Characters take random actions, a new one every half second, and no episode ends: they fall, and struggle on the ground
for 10 s, most with their objects near them. Training ends the episodes of fallen characters, so it needs less.

``contacts`` and ``constraints`` are the room of each simulation, by ``contact_room`` and ``constraint_room``.
``most_contacts`` and ``most_constraints`` are the largest numbers in any simulation. All simulations share the room for
contacts, so that their average counts, whose largest value is ``average_contacts``.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from report import about, table, write

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.physics.warp import constraint_room, contact_room
from torchrl_mcp.runs import build

RESULTS = Path(__file__).resolve().parent / "results" / "contact_room.csv"
TASKS = ("heading", "heading+self_collision", "carry", "dribble", "imitation")
SCENES = (*(f"{task}-{character}" for task in TASKS for character in CHARACTERS), "holdout-ant")
HELD = 15
"""Control steps of an action."""
NEAR = {"object_distances": (0.0, 1.5), "target_distances": (0.0, 1.5)}
"""Metres; an object lies where a fallen character reaches it."""


def measure(scene: str, num_envs: int, steps: int) -> dict[str, Any]:
    """Let characters fall in a scene, and return its row."""
    name, character = scene.split("-")
    task, *options = name.split("+")
    lasting: dict[str, Any] = {"max_episode_steps": steps + 1, **dict.fromkeys(options, True)}
    lasting |= {"terminate_when_unhealthy" if task == "holdout" else "terminate_on_fall": False}
    lasting |= {"max_error": 1e3} if task == "imitation" else NEAR if task in ("carry", "dribble") else {}
    stage = "pretrain" if task in ("holdout", "imitation") else "transfer"
    cfg = build.compose_run(f"task={task}", f"character={character}", f"stage={stage}")
    env = build.make_env(cfg, num_envs=num_envs, seed=0, physics="warp", **lasting)
    simulation, state, generator = env.simulation, env.reset(), torch.Generator().manual_seed(0)
    low, high = env.action_spec.space.low, env.action_spec.space.high
    contacts, constraints = [], []
    for step in range(steps):
        if step % HELD == 0:
            action = low + torch.rand(low.shape, generator=generator) * (high - low)
        _, state = env.step_and_maybe_reset(state.set("action", action))
        owners = simulation._data.contact.worldid.numpy()[: simulation._data.nacon.numpy()[0]]
        contacts.append(np.bincount(owners, minlength=num_envs))
        constraints.append(simulation._data.nefc.numpy().max())
    room = contact_room(simulation.model)
    rows = constraint_room(simulation.model, room)
    most, most_rows = int(np.max(contacts)), int(np.max(constraints))
    return {
        "scene": scene,
        "contacts": room,
        "average_contacts": round(float(np.mean(contacts, 1).max()), 1),
        "most_contacts": most,
        "of_contacts": round(most / room, 2),
        "constraints": rows,
        "most_constraints": most_rows,
        "of_constraints": round(most_rows / rows, 2),
        "faults": env.num_diverged,
    }


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few simulations for 2 s")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES, metavar="TASK-CHARACTER")
    parser.add_argument("--output", type=Path, help=f"CSV file; without --quick it is {RESULTS.name} by default")
    arguments = parser.parse_args()
    num_envs, steps = (8, 60) if arguments.quick else (32, 300)
    rows = []
    for scene in arguments.scenes:
        rows.append(measure(scene, num_envs, steps))
        print(" ".join(f"{key}={value}" for key, value in rows[-1].items()), flush=True)
    print(table(rows))
    if output := arguments.output or (None if arguments.quick else RESULTS):
        conditions = {"num_envs": num_envs, "steps": steps, **about()}
        write(output, [{**row, **conditions} for row in rows])


if __name__ == "__main__":
    main()
